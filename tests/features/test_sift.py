import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from fieldstone.features.descriptors_numba import DESCRIPTOR_SCALE
from fieldstone.features.sift import Sift, SiftOptions, reduced_grey, spread
from fieldstone.run.matching.detection import opencv_threads


def blob(x: float, y: float, sigma: float, width: int = 180, height: int = 160) -> np.ndarray:
    """A bright Gaussian blob centred at (x, y), corner convention."""
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    grey = 40 + 180 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    return np.rint(grey).astype(np.uint8)[..., None].repeat(3, axis=2)


def texture(seed: int, width: int = 320, height: int = 240) -> np.ndarray:
    """Noise of several scales and colours."""
    rng = np.random.default_rng(seed)
    out = np.zeros((height, width, 3), dtype=np.float32)
    for step in (4, 8, 16, 40):
        small = rng.normal(size=(height // step + 2, width // step + 2, 3)).astype(np.float32)
        out += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 40 * out, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.5, 2.0, 4.0, 8.0])
def test_a_blob_is_found_where_it_is_at_every_octave(sigma):
    rng = np.random.default_rng(int(10 * sigma))
    offsets = []
    for _ in range(12):
        x, y = rng.uniform(70, 90, size=2)
        found = Sift()(blob(x, y, sigma))
        nearest = np.argmin(np.linalg.norm(found.keypoints - [x, y], axis=1))
        offsets.append(found.keypoints[nearest] - [x, y])
        assert 0.7 < found.scale[nearest] / sigma < 1.1
    # The detector works on 8-bit grey levels: a few hundredths of a pixel of the scale at which it looks.
    assert np.max(np.abs(np.mean(offsets, axis=0))) < 0.015 * sigma
    assert np.max(np.abs(offsets)) < 0.05 * sigma


def test_reduced_photos_give_keypoints_of_the_full_photo():
    # 901 x 640 reduces to 500 x 355: both axes round differently.
    x, y = 431.3, 250.8
    image = blob(x, y, 9.0, 901, 640)
    found = Sift(SiftOptions(max_image_size=500))(image)
    nearest = np.argmin(np.linalg.norm(found.keypoints - [x, y], axis=1))
    np.testing.assert_allclose(found.keypoints[nearest], [x, y], atol=0.1)
    assert 0.7 < found.scale[nearest] / 9.0 < 1.1
    assert reduced_grey(image, 500).shape == (355, 500)
    assert reduced_grey(image, 901).shape == (640, 901)


def test_angles_turn_with_the_photo():
    image = texture(1, 240, 240)
    upright, turned = Sift()(image), Sift()(np.ascontiguousarray(np.rot90(image)))
    # A quarter turn to the left takes (x, y) to (y, 240 - x), and directions (y down) from angle to angle - 90 deg.
    moved = np.stack([upright.keypoints[:, 1], 240 - upright.keypoints[:, 0]], axis=1)
    distance = np.linalg.norm(moved[:, None] - turned.keypoints[None], axis=2)
    turn = np.angle(np.exp(1j * (turned.angle[None] - upright.angle[:, None] + np.pi / 2)))
    same = (distance < 0.2) & (np.abs(turn) < 0.1)
    assert np.mean(same.any(axis=1)) > 0.8


def test_descriptors_turn_with_the_photo():
    image = texture(1, 240, 240)
    upright, turned = Sift()(image), Sift()(np.ascontiguousarray(np.rot90(image)))
    moved = np.stack([upright.keypoints[:, 1], 240 - upright.keypoints[:, 0]], axis=1)
    distance = np.linalg.norm(moved[:, None] - turned.keypoints[None], axis=2)
    turn = np.angle(np.exp(1j * (turned.angle[None] - upright.angle[:, None] + np.pi / 2)))
    a, b = np.nonzero((distance < 0.05) & (np.abs(turn) < 0.02))
    between = np.linalg.norm(upright.descriptors[a].astype(float) - turned.descriptors[b].astype(float), axis=1)
    assert len(a) > 0.7 * len(upright)
    # Unrelated ones are some 400 apart.
    assert np.median(between) < 15


def test_keypoints_grow_with_the_photo():
    small = texture(2, 160, 120)
    size = 320, 240
    large = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    options = SiftOptions(scarce=0)
    a, b = Sift(options)(small), Sift(options)(large)
    # Compared where both are seen well: not as small as pixels, not so large that octaves end.
    a = a[(a.scale > 1.5) & (a.scale < 6.0)]
    ratio = np.log2(b.scale[None] / (2 * a.scale[:, None]))
    distance = np.linalg.norm(2 * a.keypoints[:, None] - b.keypoints[None], axis=2) / b.scale[None]
    assert np.mean(((distance < 0.2) & (np.abs(ratio) < 0.1)).any(axis=1)) > 0.85


def opencv_sift(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keypoints (corner convention), scales, angles and RootSIFT descriptors of OpenCV."""
    sift = cv2.SIFT.create(contrastThreshold=0.02, edgeThreshold=10, sigma=1.6, enable_precise_upscale=True)
    found, raw = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    xy, size, angle = (np.array([getattr(k, name) for k in found]) for name in ("pt", "size", "angle"))
    root = DESCRIPTOR_SCALE * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
    return xy + 0.5, size / 2, np.deg2rad(angle), np.minimum(root, 255)


def test_opencv_finds_most_of_the_same_and_describes_it_alike():
    image = texture(4, 400, 300)
    ours = Sift(SiftOptions(max_features=10**6, scarce=0))(image)
    xy, scale, angle, descriptors = opencv_sift(image)
    distance = np.linalg.norm(ours.keypoints[:, None] - xy[None], axis=2)
    same_scale = np.abs(np.log2(ours.scale[:, None] / scale[None])) < 0.15
    same_place = (distance < 0.5) & same_scale
    assert np.mean(same_place.any(axis=1)) > 0.7
    assert np.mean(same_place.any(axis=0)) > 0.7
    turn = np.angle(np.exp(1j * (ours.angle[:, None] - angle[None])))
    a, b = np.nonzero(same_place & (np.abs(turn) < 0.1))
    between = np.linalg.norm(ours.descriptors[a].astype(float) - descriptors[b], axis=1)
    assert len(a) > 0.5 * len(ours)
    # Unrelated ones are some 400 apart.
    assert np.median(between) < 70


def test_no_region_starves_and_the_strongest_of_each_cell_stay():
    rng = np.random.default_rng(2)
    crowded = rng.uniform([0, 0], [10, 100], size=(900, 2))
    lonely = rng.uniform([50, 0], [100, 100], size=(60, 2))
    xy = np.concatenate([crowded, lonely])
    response = np.concatenate([rng.uniform(1.0, 2.0, 900), rng.uniform(0.0, 0.1, 60)])
    options = SiftOptions(max_features=300, cells_per_axis=4)
    kept = spread(xy, response, (100, 100), options)
    assert len(kept) == len(set(kept.tolist())) == 300
    assert set(range(900, 960)) <= set(kept.tolist())
    for cell in range(4):
        members = np.flatnonzero((xy[:, 0] < 25) & (xy[:, 1] // 25 == cell))
        chosen = np.intersect1d(kept, members)
        left = np.setdiff1d(members, chosen)
        assert response[chosen].min() > response[left].max()


def test_features_are_the_same_every_time_largest_first_and_survive_pickling():
    image = texture(3)
    threads = cv2.getNumThreads()
    extractor = pickle.loads(pickle.dumps(Sift(SiftOptions(max_features=200))))  # noqa: S301
    try:
        cv2.setNumThreads(1)
        one = extractor(image)
        cv2.setNumThreads(2)
        two = extractor(image)
    finally:
        cv2.setNumThreads(threads)
    assert len(one) == 200
    for name in ("keypoints", "scale", "angle", "descriptors", "colors"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert np.all(np.diff(one.scale) <= 0)
    inside = one.keypoints.astype(int)
    np.testing.assert_array_equal(one.colors, image[inside[:, 1], inside[:, 0]])


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (40, 3), (64, 64)])
def test_a_photo_without_texture_has_no_features(shape):
    found = Sift()(np.full((*shape, 3), 77, dtype=np.uint8))
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)
    assert found.descriptors.dtype == np.uint8


def test_options_refuse_nonsense():
    for wrong in (
        lambda: SiftOptions(max_features=0),
        lambda: SiftOptions(max_image_size=0),
        lambda: SiftOptions(contrast_threshold=0.0),
        lambda: SiftOptions(coarse_ratio=0.0),
        lambda: SiftOptions(enough_ratio=1.5),
        lambda: SiftOptions(cells_per_axis=0),
    ):
        with pytest.raises(ValueError):
            wrong()


def test_features_under_a_mask_leave_their_room_to_others():
    image = texture(0, 300, 200)
    keep = np.zeros((200, 300), dtype=bool)
    keep[:, :100] = True
    everything = Sift(SiftOptions(max_features=10**6, scarce=0))(image)
    inside = everything[everything.keypoints[:, 0] < 100.0]
    masked = Sift(SiftOptions(max_features=10**6, scarce=0))(image, keep)
    np.testing.assert_array_equal(masked.keypoints, inside.keypoints)
    np.testing.assert_array_equal(masked.descriptors, inside.descriptors)
    few = Sift(SiftOptions(max_features=50))(image, keep)
    assert len(inside) > 50
    assert len(few) == 50
    assert len(Sift()(image, np.zeros_like(keep))) == 0


def test_the_strongest_alone_are_described_as_among_all():
    image = texture(0, 300, 200)
    everything = Sift(SiftOptions(max_features=10**6, scarce=0))(image)
    few = Sift(SiftOptions(max_features=50))(image)
    assert len(everything) > 80
    assert len(few) == 50
    of = {(*k, a): d for k, a, d in zip(everything.keypoints, everything.angle, everything.descriptors, strict=True)}
    for keypoint, angle, descriptor in zip(few.keypoints, few.angle, few.descriptors, strict=True):
        np.testing.assert_array_equal(descriptor, of[(*keypoint, angle)])


@pytest.mark.parametrize(
    ("size", "sizes"),
    [((3000, 2000), (1040, 1600)), ((1500, 1000), (1040, 1500)), ((1000, 1250), (1250,)), ((80, 60), (80,))],
)
def test_detection_is_coarse_first_where_that_saves_time(size, sizes):
    assert Sift().detection_sizes(*size) == sizes
    assert Sift(SiftOptions(coarse_ratio=1.0)).detection_sizes(*size) == sizes[-1:]


def test_enough_features_at_the_coarse_size_are_all_there_is():
    image = texture(3, 640, 480)
    options = SiftOptions(max_features=40, max_image_size=640, coarse_ratio=0.5)
    found, coarse = Sift(options)(image), Sift(replace(options, max_image_size=320, coarse_ratio=1.0))(image)
    assert len(found) >= options.enough_ratio * options.max_features
    np.testing.assert_array_equal(found.keypoints, coarse.keypoints)
    np.testing.assert_array_equal(found.descriptors, coarse.descriptors)
    np.testing.assert_array_equal(found.colors, coarse.colors)


def test_too_few_features_are_worth_a_finer_detection():
    image = texture(3, 640, 480)
    options = SiftOptions(max_features=10**5, max_image_size=640, coarse_ratio=0.5)
    found, close = Sift(options)(image), Sift(replace(options, coarse_ratio=1.0))(image)
    np.testing.assert_array_equal(found.keypoints, close.keypoints)
    np.testing.assert_array_equal(found.descriptors, close.descriptors)


def test_a_smaller_picture_of_the_photo_gives_features_in_its_pixels():
    image = texture(3, 640, 480)
    small = np.asarray(cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    found = Sift(SiftOptions(max_image_size=320)).detect(reduced_grey(small, 320), small, (640, 480))
    alone = Sift(SiftOptions(max_image_size=320))(small)
    np.testing.assert_allclose(found.keypoints, 2 * alone.keypoints, rtol=1e-12)
    np.testing.assert_allclose(found.scale, 2 * alone.scale, rtol=1e-12)
    np.testing.assert_array_equal(found.colors, alone.colors)


@pytest.mark.parametrize("threads", [2, 3])
def test_photos_in_threads_side_by_side_give_the_same_bytes(threads):
    images = [texture(seed, 640, 480) for seed in range(5, 9)]
    extractor = Sift(SiftOptions(max_features=300))
    alone = [extractor(image) for image in images]
    with opencv_threads(threads), ThreadPoolExecutor(threads) as pool:
        assert cv2.getNumThreads() == threads
        together = list(pool.map(extractor, images))
    for one, other in zip(alone, together, strict=True):
        for name in ("keypoints", "scale", "angle", "descriptors", "colors"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def faint_blobs() -> tuple[np.ndarray, np.ndarray]:
    """Blobs six grey levels high on a grid, too faint for the ordinary threshold, and where they are."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(20, 300, 20), np.arange(20, 220, 20))
    centers = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-3, 3, size=(x.size, 2))
    column, row = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    grey = np.full((240, 320), 90.0)
    for cx, cy in centers:
        grey += 6.0 * np.exp(-((column - cx) ** 2 + (row - cy) ** 2) / (2 * 2.5**2))
    return np.rint(grey).astype(np.uint8)[..., None].repeat(3, axis=2), centers


def test_a_photo_that_shows_little_is_searched_for_faint_features():
    image, centers = faint_blobs()
    assert not len(Sift(SiftOptions(scarce=0))(image))
    found = Sift()(image)
    distance = np.linalg.norm(centers[:, None] - found.keypoints, axis=2).min(axis=1)
    # Grey levels of 8 bits step in sixths of such a blob, which makes some of them too faint or too ragged.
    assert np.mean(distance < 0.5) > 0.75
    assert np.median(distance) < 0.2


def test_enough_features_need_no_faint_ones():
    image = texture(3, 640, 480)
    options = SiftOptions(max_features=500)
    assert options.enough_ratio * options.max_features < len(Sift(options)(image)) < options.scarce
    np.testing.assert_array_equal(Sift(options)(image).keypoints, Sift(replace(options, scarce=0))(image).keypoints)
