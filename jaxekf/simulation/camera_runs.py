"""Simulated runs of a camera and an IMU that follow a figure eight in front of two textured planes.

The experiment of Hol (2008): an eight of 2.6 m in 5.4 s, at up to 4 m/s^2 and 1 rad/s; a camera of 320 by
240 pixels with a lens of 3.2 mm, at 12.5 Hz; landmarks on a wall and a floor. The scene's x points up.
"""

from dataclasses import dataclass, field

import numpy as np

from jaxekf._support import arrays
from jaxekf.geometry import pinhole
from jaxekf.recordings.types import Camera, Flags, Floats, Recording, Times, from_scipy, to_scipy
from jaxekf.simulation.attitude_runs import Motion, sample_times, seconds
from jaxekf.simulation.marker_runs import ToolGrade, ToolMotion, Unrecorded, with_truth

PERIOD_S = 5.4
GRAVITY_REF = np.array([-9.81, 0.0, 0.0])
IMAGE = (320, 240)
FOCAL = 213.3
"""Pixels: 3.2 mm at 15 um a pixel."""
_TOWARDS_SCENE = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""Body to scene of a body that faces the wall: its z along the scene's, its x to the right (the scene's
y), its y down (against the scene's x)."""


@dataclass(frozen=True)
class CameraGrade:
    """Noise and rates of camera and IMU.

    Examples
    --------
    >>> from jaxekf.simulation import camera_runs
    >>> few = camera_runs.CameraGrade(points=6)
    >>> run = camera_runs.camera_recording("camera", seed=1, duration_s=1.0, grade=few)
    >>> int(run.camera.visible.sum(axis=1).max())  # landmarks of an image
    6
    """

    imu: ToolGrade = field(
        default_factory=lambda: ToolGrade(
            gyroscope_deg=0.05,
            accelerometer_mg=2.0,
            bias_walk_deg=0.002,
            accelerometer_walk=1e-3,
            bias_deg=0.5,
            accelerometer_bias=0.1,
            imu_s=0.01,
        )
    )
    camera_hz: float = 12.5
    points: int = 30
    """Largest number of landmarks detected in an image."""
    pixel: float = 0.7
    """Standard deviation of an image point per axis, pixels."""
    mismatched: float = 0.0
    """Share of points that belong to another landmark in the image."""
    blurred: float = np.inf
    """rad/s: in images taken at faster rotation nothing is detected."""


@dataclass(frozen=True)
class Mount:
    """Pose of the camera in the body, and its lens.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import camera_runs
    >>> mount = camera_runs.Mount(radial=np.zeros(2))  # a lens without distortion
    >>> run = camera_runs.camera_recording("camera", seed=1, duration_s=1.0, mount=mount)
    >>> run.camera.radial.tolist()
    [0.0, 0.0]
    """

    p_body_camera: Floats = field(default_factory=lambda: np.array([0.03, -0.02, 0.05]))
    q_body_camera: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    radial: Floats = field(default_factory=lambda: np.array([-0.1, 0.01]))


@dataclass(frozen=True)
class Facing(Motion):
    """A motion relative to the attitude in which the body faces the wall."""

    def attitude(self, t: Floats) -> tuple[Floats, Floats]:
        """As in `Motion`."""
        q, rate = super().attitude(t)
        return from_scipy(to_scipy(_TOWARDS_SCENE) * to_scipy(q)), rate


def eight(seed: int = 0) -> ToolMotion:
    """The eight, 2.6 m wide and 1.1 m high, in front of the wall; `seed` varies the sway of the body.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import camera_runs
    >>> path = camera_runs.eight().position(np.linspace(0.0, camera_runs.PERIOD_S, 1001))
    >>> np.ptp(path[:, :2], axis=0).round(2).tolist()  # height and width, m
    [1.1, 2.6]
    """
    rng = np.random.default_rng([seed, 31])
    once = 1.0 / PERIOD_S
    # x up, y along the wall, z to it: sums of a constant (a sinusoid of frequency 0) and sinusoids.
    amplitude = np.array([[1.4, 0.55], [0.0, 1.3], [-2.6, 0.15]])
    frequency = np.array([[0.0, 2.0 * once], [0.0, once], [0.0, once]])
    phase = np.array([[np.pi / 2, 0.0], [np.pi / 2, 0.0], [np.pi / 2, rng.uniform(0.0, 6.28)]])
    sway = Facing(
        amplitude=np.deg2rad([[7.0, 3.0], [9.0, 4.0], [8.0, 4.0]]),
        frequency=np.array([[once, 2.0 * once], [once, 2.0 * once], [once, 3.0 * once]]),
        phase=rng.uniform(0.0, 2.0 * np.pi, (3, 2)),
    )
    return ToolMotion(sway, amplitude, frequency, phase)


def shaken(seed: int = 0) -> ToolMotion:
    """A hand that rotates and shakes the camera in front of the wall, by up to 20 deg and some 2 rad/s.

    This motion determines the camera's pose in the body.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import camera_runs
    >>> _, rate = camera_runs.shaken().attitude.attitude(np.linspace(0.0, 10.0, 1001))
    >>> 0.5 < float(np.linalg.norm(rate, axis=1).max()) < 3.0  # rad/s
    True
    """
    rng = np.random.default_rng([seed, 34])
    size = (3, 2)
    sway = Facing(
        amplitude=np.deg2rad(rng.uniform(5.0, 8.0, size)),
        frequency=rng.uniform(0.6, 1.4, size),
        phase=rng.uniform(0.0, 2.0 * np.pi, size),
    )
    place = np.array([[1.4], [0.0], [-2.6]])
    shake = rng.uniform(0.05, 0.15, size)
    return ToolMotion(
        sway,
        np.concatenate([place, shake], axis=1),
        np.concatenate([np.zeros((3, 1)), rng.uniform(0.3, 0.8, size)], axis=1),
        np.concatenate([np.full((3, 1), np.pi / 2), rng.uniform(0.0, 6.28, size)], axis=1),
    )


def resting() -> ToolMotion:
    """A static body at the middle of the eight, facing the wall.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.simulation import camera_runs
    >>> camera_runs.resting().position(np.array([0.0, 5.0])).round(6).tolist()
    [[1.4, 0.0, -2.6], [1.4, 0.0, -2.6]]
    """
    nothing = np.zeros((3, 1))
    place, up = np.array([[1.4], [0.0], [-2.6]]), np.full((3, 1), np.pi / 2)
    still = Facing(amplitude=nothing, frequency=nothing, phase=nothing)
    return ToolMotion(still, place, nothing, up)


def scene(seed: int = 0, count: int = 160) -> Floats:
    """Landmarks (count, 3), m: half of them on the wall (z = 0), half on the floor (x = 0).

    Examples
    --------
    >>> from jaxekf.simulation import camera_runs
    >>> points = camera_runs.scene(count=10)
    >>> points[:5, 2].tolist(), points[5:, 0].tolist()  # wall and floor
    ([0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0])
    """
    rng = np.random.default_rng([seed, 32])
    wall = count // 2
    points = np.zeros((count, 3))
    points[:wall, :2] = rng.uniform([0.1, -3.2], [3.2, 3.2], (wall, 2))
    points[wall:, 1:] = rng.uniform([-3.2, -2.2], [3.2, 0.0], (count - wall, 2))
    return points


def camera_recording(
    name: str,
    motion: ToolMotion | None = None,
    *,
    seed: int,
    duration_s: float,
    grade: CameraGrade | None = None,
    mount: Mount | None = None,
    landmarks: Floats | None = None,
    blind: tuple[tuple[float, float], ...] = (),
    start_ns: int = 0,
) -> Recording:
    """Record a motion as landmarks in images, with an IMU and the true pose at the IMU's times.

    Parameters
    ----------
    name
        Name of the run.
    motion
        The motion, by default the eight.
    seed
        Seed of all noise.
    duration_s
        Length, s.
    grade
        Noise and rates of the sensors.
    mount
        The camera's pose in the body, and its lens.
    landmarks
        (L, 3) m, by default `scene`.
    blind
        (start, end) in seconds without detections.
    start_ns
        Time of the first samples, ns.

    Examples
    --------
    >>> from jaxekf.simulation import camera_runs
    >>> run = camera_runs.camera_recording("camera", seed=1, duration_s=2.0, blind=((0.5, 1.0),))
    >>> seen, t = run.camera.visible.any(axis=1), run.camera.time_ns / 1e9  # s
    >>> list(run.streams), bool(seen[(t > 0.5) & (t < 1.0)].any())
    (['camera', 'imu', 'encoder'], False)
    """
    return camera_run(
        name,
        motion,
        seed=seed,
        duration_s=duration_s,
        grade=grade,
        mount=mount,
        landmarks=landmarks,
        blind=blind,
        start_ns=start_ns,
    )[0]


def camera_run(
    name: str,
    motion: ToolMotion | None = None,
    *,
    seed: int,
    duration_s: float,
    grade: CameraGrade | None = None,
    mount: Mount | None = None,
    landmarks: Floats | None = None,
    blind: tuple[tuple[float, float], ...] = (),
    start_ns: int = 0,
) -> tuple[Recording, Unrecorded]:
    """The same as `camera_recording`, with the ground truth that a recording does not hold.

    Examples
    --------
    >>> from jaxekf.simulation import camera_runs
    >>> run, truth = camera_runs.camera_run("camera", seed=1, duration_s=1.0)
    >>> truth.accelerometer_bias.shape == run.need_imu().accelerometer.shape
    True
    """
    grade, mount = grade or CameraGrade(), mount or Mount()
    motion = eight(seed) if motion is None else motion
    landmarks = scene() if landmarks is None else landmarks
    landmarks = arrays.floats(landmarks, arrays.argument("landmarks"), (None, 3))
    rng = np.random.default_rng([seed, 33])
    imu_ns = sample_times(1.0 / grade.imu.imu_s, duration_s, start_ns)
    images = sample_times(grade.camera_hz, duration_s, start_ns)
    camera = _camera(motion, images, landmarks, grade, mount, blind, rng)
    info = {"simulated": True, "seed": seed, "gravity_ref": GRAVITY_REF.tolist()}
    return with_truth(Recording(name, info=info, camera=camera), motion, imu_ns, rng, grade.imu)


def _camera(
    motion: ToolMotion,
    taken_ns: Times,
    landmarks: Floats,
    grade: CameraGrade,
    mount: Mount,
    blind: tuple[tuple[float, float], ...],
    rng: np.random.Generator,
) -> Camera:
    """Detections in each image: a random choice of the visible landmarks."""
    t = seconds(taken_ns)
    q, rate = motion.attitude.attitude(t)
    body = to_scipy(q)
    turn = body * to_scipy(mount.q_body_camera)
    away = motion.position(t) + body.apply(mount.p_body_camera)
    inside = np.stack([turn.inv().apply(point - away) for point in landmarks], axis=1)
    exact, there = _image(inside, mount)
    there &= (np.linalg.norm(rate, axis=1) <= grade.blurred)[:, None]
    for begin, end in blind:
        there &= ~((t >= begin) & (t < end))[:, None]
    order = np.argsort(np.where(there, rng.uniform(size=there.shape), 2.0), axis=1)
    chosen = np.zeros_like(there)
    np.put_along_axis(chosen, order[:, : grade.points], True, axis=1)
    found = chosen & there
    pixel = exact + grade.pixel * rng.standard_normal(exact.shape)
    wrong = found & (rng.uniform(size=found.shape) < grade.mismatched)
    for image in np.flatnonzero(wrong.any(axis=1)):
        others = np.flatnonzero(there[image])
        at = np.flatnonzero(wrong[image])
        pixel[image, at] = exact[image, rng.choice(others, len(at))]
    pixel[~found] = np.nan
    names = tuple(f"L{i}" for i in range(len(landmarks)))
    lens = (np.full(2, FOCAL), np.array(IMAGE) / 2.0, mount.radial)
    return Camera(
        taken_ns, pixel, found, names, landmarks, *lens, mount.p_body_camera, mount.q_body_camera
    )


def _image(inside: Floats, mount: Mount) -> tuple[Floats, Flags]:
    """Image points (N, L, 2) of landmarks (N, L, 3) in the camera frame, and those within the image."""
    ahead = inside[..., 2] > 10.0 * pinhole.NEAREST
    point = inside[..., :2] / np.where(ahead, inside[..., 2], 1.0)[..., None]
    r2 = np.sum(point * point, axis=-1)
    # Beyond the corners the distortion would fold points back into the image.
    ahead &= r2 < 1.1 * np.sum((np.array(IMAGE) / (2.0 * FOCAL)) ** 2) / 0.9**2
    pixel = FOCAL * point * pinhole.stretch(mount.radial, point)[..., None] + np.array(IMAGE) / 2.0
    inside_image = ((pixel >= 0.0) & (pixel < np.array(IMAGE))).all(axis=-1)
    return pixel, ahead & inside_image
