"""fieldstone: photos in, a scene that you can walk through out, on an ordinary laptop.

    import fieldstone as fs

    scene = fs.reconstruct("photos/")
    field = fs.train(scene, budget_s=60)
    view = field.render(scene.photos.camera_of(0), scene.photos.pose_of(0))
    field.mesh().save("house.glb")
    field.save("out")

Beside these verbs and values, `fieldstone.geometry`, `fieldstone.solve` and `fieldstone.io` are the same mathematics on
arrays. Nothing is loaded before it is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
