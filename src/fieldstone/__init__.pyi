from . import geometry as geometry
from . import io as io
from . import solve as solve
from .errors import InputError as InputError
from .progress import Progress as Progress
from .run.field import Field as Field
from .run.field import open_field as open_field
from .run.options import RenderOptions as RenderOptions
from .run.options import SurfaceOptions as SurfaceOptions
from .run.options import TrainOptions as TrainOptions
from .run.reconstruct import reconstruct as reconstruct
from .run.reconstruct_options import ReconstructOptions as ReconstructOptions
from .run.render import render as render
from .run.scene import Scene as Scene
from .run.scene import open_scene as open_scene
from .run.train import train as train

__version__: str
