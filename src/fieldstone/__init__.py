"""fieldstone: photos in, a scene that you can walk through out, on an ordinary laptop."""

__version__ = "0.1.0"
