"""Estimation on arrays: minimal and linear solvers, RANSAC, triangulation, bundle adjustment, averaging.

`__init__.pyi` lists what is public; a name is imported (and with it numba) when it is first used.

    import fieldstone.solve as s

    E = s.five_point(bearings1, bearings2)                                    # list of (3, 3), |E| = sqrt(2)
    poses = s.p3p(bearings, points_in_world)                                  # list of Rigid3, cam_from_world
    found = s.estimate_absolute_pose(camera, pixels, points_in_world, s.RansacOptions(), rng)
    pair = s.estimate_two_view(camera1, camera2, pixels1, pixels2, s.TwoViewOptions(), rng)
    result = s.bundle_adjust(problem, s.BundleOptions(loss="cauchy"))         # .problem, .final_cost, .reason
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
