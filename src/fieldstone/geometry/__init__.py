"""Pure mathematics on arrays: rotations, transforms, cameras, epipolar geometry, triangulation.

`__init__.pyi` lists what is public; a name is imported when it is first used. Frames, axes and units are those of
docs/conventions.md: x right, y down, z forward; pixels with the corner of the image at (0, 0); radians.

    import fieldstone.geometry as g

    camera = g.Camera("PINHOLE", 640, 480, np.array([500.0, 500.0, 320.0, 240.0]))
    pose = g.look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3), up=np.array([0.0, 0.0, 1.0]))
    pixels = g.image_from_cam(camera, pose.apply(points_in_world))
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
