"""The edges of the world: file formats in and out, conventions converted once, on the line that reads them."""
