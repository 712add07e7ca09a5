"""The edges of the world: file formats in and out, conventions converted once, on the line that reads them.

`__init__.pyi` lists what is public; a name is imported when it is first used. Paths are `pathlib.Path`; frames, axes
and pixels are those of docs/conventions.md, whatever the file has: cameras look along z with y down, poses are
`cam_from_world`, colours are sRGB. A file that cannot be used raises `fieldstone.InputError`, which says what to do;
what is written appears whole or not at all.

    import fieldstone.io as fio

    model = fio.read_colmap(folder)                       # Reconstruction: .cameras, .views, .points, .observations
    fio.write_colmap(model, folder / "copy")              # binary; binary=False: text
    scene = fio.open_posed_scene(folder)                  # COLMAP, transforms.json, Blender or LLFF: a PosedScene
    rgb = fio.read_photo(folder / "images" / "1.jpg").rgb  # (height, width, 3), 8 bits, upright
    given = fio.read_given_matches(folder)                # .graph, .camera
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
