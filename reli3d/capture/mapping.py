"""Structure from motion by COLMAP (pycolmap): cameras and sparse points of photographs.

Cameras are world-to-camera in OpenCV axes here (+X right, +Y down, looking along +Z), as COLMAP has them.
"""

from __future__ import annotations

import math
import signal
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from reli3d.capture.photos import Photo, Progress, optional_module
from reli3d.errors import InputError

FEATURES = 4096  # SIFT features of an image
MAP_SIDES = 1000, 2000  # pixels along the longer side, first and where too few images are registered
LOW_PEAK = 0.003  # SIFT's peak threshold: with its default, 0.0067, a dark object has 0.7 times the points
MATCH_RATIO = 0.85  # of nearest to second-nearest descriptor: with 0.8 a dark object has 0.75 times the points
PAIR_TRIALS = 1000  # of RANSAC for a pair of images: most do not overlap; COLMAP's 10,000 make matching 4 times slower
ENOUGH = 0.8  # fraction of the images whose registration needs no retry
SEED = 0
DEFAULT_FOCAL = 1.2  # of the longer side, where EXIF has none: a phone's main camera, and COLMAP's own default
LENS_STEPS = 8  # fixed-point iterations that undo the distortion of a lens
MASK_MARGIN = 0.01  # of the longer side, by which masks are grown: features sit on the outline too


@dataclass(frozen=True)
class View:
    """A registered image: its pose, its lens and which of the map's points it shows where."""

    photo: Photo
    rotation: np.ndarray  # (3, 3) world to camera
    translation: np.ndarray  # (3,)
    focal: float  # pixels of the photo
    principal: np.ndarray  # (2,) pixels
    radial: float  # k1 of x (1 + k1 r^2)
    pixels: np.ndarray  # (K, 2) of observed points, of the photo as it is
    points: np.ndarray  # (K,) index of these points

    @property
    def eye(self) -> np.ndarray:
        """Position ``(3,)`` of the camera."""
        return -self.rotation.T @ self.translation

    @property
    def c2w(self) -> np.ndarray:
        """Camera to world ``(4, 4)`` in OpenGL axes."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation.T @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = self.eye
        return pose

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels ``(N, 2)`` of the photo and depths ``(N,)`` of ``points (N, 3)``, with the lens's distortion.

        Both have the precision of ``points``.  Coordinates lie in rows: 4 times faster than a row for each point.
        """
        turn, shift, middle = (a.astype(points.dtype) for a in (self.rotation, self.translation, self.principal))
        local = turn @ points.T + shift[:, None]
        flat = local[:2] / np.where(np.abs(local[2]) > 1e-9, local[2], 1e-9)
        bent = flat * (float(self.focal) * (1.0 + self.radial * (flat[0] ** 2 + flat[1] ** 2)))
        return (bent + middle[:, None]).T, local[2]

    def normalized(self, pixels: np.ndarray) -> np.ndarray:
        """``x / z`` and ``y / z`` ``(N, 2)`` in the camera's axes of ``pixels (N, 2)``: the inverse of ``project``."""
        bent = (pixels - self.principal) / self.focal
        flat = bent
        for _ in range(LENS_STEPS):
            flat = bent / (1.0 + self.radial * _squared(flat))
        return flat

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """World directions ``(N, 3)``, of depth 1, of ``pixels (N, 2)``."""
        flat = self.normalized(pixels)
        return np.concatenate([flat, np.ones((len(flat), 1))], 1) @ self.rotation

    def undistorted(self, image: np.ndarray) -> np.ndarray:
        """``image`` as a pinhole of the same focal length and principal point shows it; black beyond its border."""
        h, w = self.photo.pixels.shape[:2]
        scale = np.array([image.shape[1] / w, image.shape[0] / h, 1.0])
        matrix = np.array([[self.focal, 0, self.principal[0]], [0, self.focal, self.principal[1]], [0, 0, 1.0]])
        matrix = matrix * scale[:, None]
        matrix[:2, 2] -= 0.5  # OpenCV's pixel centers are at whole numbers
        lens = np.array([self.radial, 0.0, 0.0, 0.0])
        at = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, (image.shape[1], image.shape[0]), cv2.CV_32FC1)
        return cv2.remap(image, *at, cv2.INTER_CUBIC)


def _squared(vectors: np.ndarray) -> np.ndarray:
    """Squared lengths ``(N, 1)`` of ``vectors (N, 2)``; 8 times faster than a sum over an axis of two."""
    return (vectors[:, 0] ** 2 + vectors[:, 1] ** 2)[:, None]


def shown_pixels(
    pixels: np.ndarray, depth: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row of the pixels inside an image of ``shape``, and which of ``pixels (N, 2)`` these are ``(N,)``."""
    x, y = np.floor(pixels).astype(np.int64).T
    shown = (depth > 0) & (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    return x[shown], y[shown], shown


def point_mask(pixels: np.ndarray, depth: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """``(H, W)`` uint8, 255 at the pixels that ``pixels (N, 2)`` inside an image of ``shape`` lie in."""
    mask = np.zeros(shape[:2], np.uint8)
    x, y, _ = shown_pixels(pixels, depth, shape)
    mask[y, x] = 255
    return mask


@dataclass(frozen=True)
class Map:
    """A reconstruction: registered views, points with mean reprojection errors, and matched features of view pairs.

    matches: indices of two views and the pixels ``(M, 2)`` in each, as the descriptors match them: no geometry is used.
    separate: number of other images that form a map of their own.
    """

    views: tuple[View, ...]
    points: np.ndarray  # (P, 3)
    error: np.ndarray  # (P,) pixels
    tracks: np.ndarray  # (P,) number of views that observe the point
    matches: tuple[tuple[int, int, np.ndarray, np.ndarray], ...] = ()
    separate: int = 0

    @property
    def mean_error(self) -> float:
        """Pixels, over all observations."""
        return float(np.average(self.error, weights=self.tracks)) if len(self.error) else math.inf


def map_photos(
    photos: Sequence[Photo],
    progress: Progress,
    masks: Sequence[np.ndarray] | None = None,
    lenses: Map | None = None,
) -> Map:
    """The largest map of ``photos``.

    masks: ``(H, W)`` of each photo, nonzero where features are looked for.  Where less than ENOUGH of the photos are
    registered it is tried again with a relaxed first pair, then with larger images; the map of most images is kept.
    With masks, which leave few features, the first pair is relaxed at once.  The seed is fixed.  lenses: a map whose
    lenses are kept.  Raises InputError where no two images can be matched.
    """
    best: Map | None = None
    attempts = [(MAP_SIDES[0], False), (MAP_SIDES[0], True), (MAP_SIDES[1], True)]
    if masks is not None:
        del attempts[0]
    if max(max(p.size) for p in photos) <= 1.2 * MAP_SIDES[0]:
        del attempts[-1]
    for side, relaxed in attempts:
        with tempfile.TemporaryDirectory(prefix="reli3d-map-") as folder:
            found = _mapped(photos, masks, lenses, Path(folder), side, relaxed, progress)
        if found and (best is None or len(found.views) > len(best.views)):
            best = found
        if best and len(best.views) >= ENOUGH * len(photos):
            break
    if best is None:
        raise InputError(
            "photographs",
            "expected images that overlap, from different places, got none that match; take sharp ones, walk around "
            "the object in small steps, and put one without texture on a sheet of newspaper",
        )
    return best


def map_if_any(
    photos: Sequence[Photo], progress: Progress, masks: Sequence[np.ndarray], lenses: Map | None = None
) -> Map | None:
    """:func:`map_photos`, or None where it finds no map."""
    with suppress(InputError):
        return map_photos(photos, progress, masks, lenses)
    return None


def _pycolmap() -> ModuleType:
    handler = signal.getsignal(signal.SIGTERM)
    module = optional_module("pycolmap")
    if threading.current_thread() is threading.main_thread() and handler is not None:
        signal.signal(signal.SIGTERM, handler)  # the import replaced it by one that prints a stack trace
    module.logging.minloglevel = 3
    return module


def _mapped(photos, masks, known: Map | None, work: Path, side: int, relaxed: bool, progress: Progress) -> Map | None:
    pycolmap = _pycolmap()
    pycolmap.set_random_seed(SEED)
    lenses = sorted({p.lens for p in photos}, key=str)
    images, database, scales, by_path = work / "images", work / "database.db", {}, {}
    for k, photo in enumerate(photos):
        path = f"{lenses.index(photo.lens)}/{k:05d}.png"
        by_path[path] = photo
        size = [round(n * min(1.0, side / max(photo.size))) for n in photo.size]
        scales[path] = np.array(size) / photo.size
        _write(images / path, photo.pixels, scales[path])
        if masks is not None:
            _write(work / "masks" / f"{path}.png", 255 * grown(masks[k] > 0, MASK_MARGIN), scales[path])
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features, extraction.sift.peak_threshold = FEATURES, LOW_PEAK
    pycolmap.Database.open(database).close()
    done = 0
    for k in range(len(lenses)):
        names = [path for path in by_path if path.startswith(f"{k}/")]
        photo = by_path[names[0]]
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", default_focal_length_factor=DEFAULT_FOCAL)
        if masks is not None:
            reader.mask_path = str(work / "masks")
        view = next((v for v in known.views if v.photo.lens == photo.lens), None) if known else None
        if view:
            scale = scales[names[0]]
            values = view.focal * scale.mean(), *(view.principal * scale), view.radial
            reader.camera_params = ",".join(str(float(x)) for x in values)
        elif photo.focal:
            (width, height), scale = photo.size * scales[names[0]], scales[names[0]].mean()
            reader.camera_params = f"{photo.focal * scale},{width / 2},{height / 2},0"
        # Numbers the images in order: the extraction would number them in the order in which its threads finish.
        pycolmap.import_images(database, images, pycolmap.CameraMode.PER_FOLDER, names, reader)
        for first in range(0, len(names), 4):  # a few at a time: the bar moves
            progress("features", done, len(photos))
            group = names[first : first + 4]
            pycolmap.extract_features(database, images, group, reader_options=reader, extraction_options=extraction)
            done += len(group)
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.sift.max_ratio, verification.ransac.max_num_trials = MATCH_RATIO, PAIR_TRIALS
    verification.ransac.random_seed = SEED  # else that of a pair depends on the thread that it meets
    progress("matching", 0, 1)
    pycolmap.match_exhaustive(database, matching, verification_options=verification)
    options = pycolmap.IncrementalPipelineOptions(min_model_size=3, random_seed=SEED, extract_colors=False)
    options.num_threads = 1  # else the first pair of images depends on the threads, where few pairs are good
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
    # Features inside masks do not tell distortion from another focal length (k1 = -0.7 and a focal length 7 % off).
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = masks is None and not known
    if relaxed:
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 8.0
        options.mapper.abs_pose_min_num_inliers = 20
    registered = [0]

    def on_next() -> None:
        registered[0] += 1
        progress("mapping", min(registered[0], len(photos)), len(photos))

    progress("mapping", 0, len(photos))
    (work / "sparse").mkdir()
    models = pycolmap.incremental_mapping(database, images, work / "sparse", options, next_image_callback=on_next)
    if not models:
        return None
    largest = max(models.values(), key=lambda m: m.num_reg_images())
    own = set(largest.reg_image_ids())
    separate = max((len(m.reg_image_ids()) for m in models.values() if own.isdisjoint(m.reg_image_ids())), default=0)
    # Most matches lie on the support: the geometry that a pair has by itself is ambiguous and rejects matches on the
    # object.  That of the map's cameras is not, and judges each match by itself: a pair needs only one.
    options.min_num_matches = verification.min_num_inliers = 1
    pycolmap.guided_geometric_verification(largest, database, two_view_geometry_options=verification)
    largest = pycolmap.triangulate_points(largest, database, images, work / "sparse", options=options)
    if masks is not None:  # few points: the added ones matter; without masks some may lie on what moves
        _adjust(largest, options.get_global_bundle_adjustment())
    with pycolmap.Database.open(database) as data:
        return replace(_read_model(largest, data, by_path, scales), separate=separate)


def _adjust(model, options) -> None:
    """Bundle adjustment of ``model``, in place, with the points that ``triangulate_points`` added to fixed cameras.

    ``pycolmap.bundle_adjustment`` computes the same and turns COLMAP's logging on.
    """
    pycolmap = _pycolmap()
    problem = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        problem.add_image(number)
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, problem, model).solve()
    model.update_point_3d_errors()


def _write(path: Path, pixels: np.ndarray, scale: np.ndarray) -> None:
    """scale: of width and height, at most 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    size = round(pixels.shape[1] * scale[0]), round(pixels.shape[0] * scale[1])
    if size != pixels.shape[1::-1]:
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    ok = cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise OSError(f"{path}: cannot be written")


def grown(mask: np.ndarray, margin: float) -> np.ndarray:
    """``mask`` dilated by ``margin``, relative to its longer side, as uint8."""
    size = 2 * round(margin * max(mask.shape)) + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))


def _read_model(model, database, by_path: dict[str, Photo], scales: dict[str, np.ndarray]) -> Map:
    index = {identifier: k for k, identifier in enumerate(model.points3D)}
    points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    error = np.array([p.error for p in model.points3D.values()])
    tracks = np.array([p.track.length() for p in model.points3D.values()])
    views = []
    registered = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name.rpartition("/")[2])
    for image in registered:
        scale, camera, pose = scales[image.name], model.cameras[image.camera_id], image.cam_from_world()
        focal, cx, cy, radial = camera.params
        observed = [p for p in image.points2D if p.has_point3D()]
        views.append(
            View(
                by_path[image.name],
                pose.rotation.matrix(),
                np.asarray(pose.translation),
                focal / float(scale.mean()),
                np.array([cx, cy]) / scale,
                float(radial),
                np.array([p.xy for p in observed]).reshape(-1, 2) / scale,
                np.array([index[p.point3D_id] for p in observed], dtype=np.int64),
            )
        )
    return Map(tuple(views), points, error, tracks, _matches(database, [image.name for image in registered], scales))


def _matches(database, paths: Sequence[str], scales: dict[str, np.ndarray]) -> tuple:
    numbers = [database.read_image_with_name(path).image_id for path in paths]
    pixels = [database.read_keypoints(n)[:, :2] / scales[path] for n, path in zip(numbers, paths, strict=True)]
    found = []
    for b in range(len(paths)):
        for a in range(b):
            pairs = database.read_matches(numbers[a], numbers[b]).astype(np.int64)
            if len(pairs) > 0:
                found.append((a, b, pixels[a][pairs[:, 0]], pixels[b][pairs[:, 1]]))
    return tuple(found)
