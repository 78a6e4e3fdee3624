"""Camera paths: hand-held-like motion through a room, and recorded motion placed into a scene."""

import zlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import erf

from edslam_ti.errors import DataError
from edslam_ti.simulation.rooms import Room
from edslam_ti.simulation.settings import SimulationConfig
from edslam_ti.trajectory import Trajectory

TYPICAL_SPEED = 0.4  # m/s, mean over a long path
REACH = (0.55, 0.45, 0.22)  # metres, largest excursion along x, y, z
DWELL = 1.2  # seconds from one sight to the next
BURST_WIDTH = 0.17  # seconds, Gaussian width of a burst of fast motion
MOVE_BURST, GAZE_BURST = 0.9, 1.6  # extra speed in a burst, as a share of the normal speed
UP = np.array([0.0, 0.0, 1.0])
BURST_INTERVAL = (1.7, 2.6)  # seconds from one burst to the next


GO, STOP = 1.0, 0.6  # seconds of motion and of rest on a stop-and-go path
FARTHEST = 1e6  # metres; float32 holds positions to 6 cm there
LOOK_AHEAD = 1.1  # metres along a tour to the point that the camera looks at
SWAY, SWAY_PERIOD = (32.0, 7.0), 6.5  # degrees of yaw and pitch that the gaze sways on a tour; seconds
BOB = 0.012  # metres that a step lifts the head
TURN_DURATION = 30.0  # seconds of a loop path for about one turn


class CameraPath(Protocol):
    """A pose for every time from 0 to `duration` seconds."""

    duration: float

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time."""


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:  # [4, 4]
    """Return T_world_camera of a camera at `position` that looks at `target`, upright."""
    forward = np.asarray(target, np.float64) - position
    length = np.linalg.norm(forward)
    right = np.cross(forward, up)
    if length < 1e-9 or np.linalg.norm(right) < 1e-9 * length:
        raise DataError(
            f"camera: cannot look from {position} at {target} with up = {up}; choose another target"
        )
    forward = forward / length
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = position
    return T


@dataclass(frozen=True)
class _Waves:
    """Sums of sinusoids, one row per coordinate."""

    amplitude: np.ndarray  # [D, K]
    frequency: np.ndarray  # [D, K] Hz
    phase: np.ndarray  # [D, K]

    def __call__(self, t: float) -> np.ndarray:  # [D]
        return (self.amplitude * np.sin(2 * np.pi * self.frequency * t + self.phase)).sum(1)


class HandHeldPath:
    """Smooth 6-DoF motion inside a room's free box, looking along its sights.

    Position: slow sinusoids. Gaze: a cubic B-spline through the sights. Both follow a warped clock with a
    burst of fast motion about every two seconds. Roll and a small hand tremor (3-9 Hz) are added.
    """

    def __init__(self, room: Room, duration: float, seed: int = 0, speed: float = 1.0) -> None:
        rng = np.random.default_rng([seed, zlib.crc32(room.name.encode())])
        self.duration = duration
        self._sights = room.sights
        half = np.minimum((room.free_high - room.free_low) / 2, REACH)
        slack = np.maximum((room.free_high - room.free_low) / 2 - half, 0)
        self._centre = (room.free_low + room.free_high) / 2 + slack * rng.uniform(-0.5, 0.5, 3)
        weights = np.array([0.55, 0.3, 0.12]) * half[:, None]  # sum 0.97 leaves room for tremor
        frequency = np.array([0.16, 0.29, 0.53]) * rng.uniform(0.85, 1.15, (3, 3))
        phase = rng.uniform(0, 2 * np.pi, (3, 3))
        slow = _Waves(weights, frequency, phase)
        # The clock's rate is chosen so that the mean speed over a minute is the typical one.
        samples = np.array([slow(t) for t in np.arange(0, 60, 0.02)])
        mean_speed = np.linalg.norm(np.diff(samples, axis=0), axis=1).mean() / 0.02
        bursts, start = [], float(rng.uniform(0.9, 1.5))
        while start < duration * speed + 3:
            bursts.append(start)
            start += float(rng.uniform(*BURST_INTERVAL))
        self._bursts = np.array(bursts)
        self._speed = speed
        self._position = _Waves(weights, frequency * TYPICAL_SPEED / mean_speed, phase)
        self._roll = _Waves(
            np.array([[4.0, 1.5]]), np.array([[0.31, 0.83]]), rng.uniform(0, 2 * np.pi, (1, 2))
        )  # degrees
        tremor = np.array([0.5, 0.3, 0.2]) * np.array([1.2e-3] * 3 + [0.12] * 3)[:, None]  # metres, degrees
        self._tremor = _Waves(tremor, rng.uniform(3, 9, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3)))
        self._first_sight = float(rng.uniform(0, len(self._sights)))

    def _clock(self, t: float, gain: float) -> float:
        """Return warped time: its rate is 1 + gain exp(-((t - burst)/width)^2), normalised to mean 1."""
        u = t * self._speed
        area = gain * BURST_WIDTH * np.sqrt(np.pi)  # seconds gained in one burst
        bumps = erf((u - self._bursts) / BURST_WIDTH) + erf(self._bursts / BURST_WIDTH)
        return float((u + area / 2 * bumps.sum()) / (1 + area / np.mean(BURST_INTERVAL)))

    def _target(self, s: float) -> np.ndarray:  # [3]
        """Return the point looked at: a closed cubic B-spline with the sights as control points."""
        position = self._first_sight + s / DWELL
        k, a = int(np.floor(position)), position % 1.0
        weights = (
            np.array([(1 - a) ** 3, 3 * a**3 - 6 * a**2 + 4, -3 * a**3 + 3 * a**2 + 3 * a + 1, a**3]) / 6
        )
        return weights @ self._sights[(k + np.arange(4)) % len(self._sights)]

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera (z up) at a time in seconds."""
        tremor = self._tremor(t)
        position = self._centre + self._position(self._clock(t, MOVE_BURST)) + tremor[:3]
        s = self._clock(t, GAZE_BURST)
        T = look_at(position, self._target(s), UP)
        return _turned(T, tremor[3:] + (self._roll(s)[0], 0, 0))


class RotationPath:
    """The rotations of a hand-held path about its start point, without translation."""

    def __init__(self, hand_held: HandHeldPath) -> None:
        self.duration = hand_held.duration
        self._hand_held = hand_held

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time in seconds."""
        T = self._hand_held.pose(t)
        T[:3, 3] = self._hand_held.pose(0.0)[:3, 3]
        return T


class StopAndGoPath:
    """A hand-held path that rests, without tremor, for STOP seconds after every GO seconds of motion."""

    def __init__(self, hand_held: HandHeldPath) -> None:
        self.duration = hand_held.duration
        self._hand_held = hand_held

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time in seconds; speed rises and falls smoothly (smoothstep)."""
        rounds, rest = divmod(t, GO + STOP)
        u = min(rest / GO, 1.0)
        return self._hand_held.pose(GO * (rounds + 3 * u**2 - 2 * u**3))


class LoopPath:
    """An ellipse around the free box that returns to the first pose while the gaze turns full circle.

    One turn of the gaze takes about TURN_DURATION, so that the first view returns only at the end.
    """

    def __init__(self, room: Room, duration: float, seed: int = 0, speed: float = 1.0) -> None:
        if not room.is_closed:
            raise DataError(
                f"path 'loop' looks in every direction: expected a closed room, got scene '{room.name}'; "
                "use another scene or path"
            )
        rng = np.random.default_rng([seed, zlib.crc32(room.name.encode()), 1])
        self.duration = duration
        self._centre = (room.free_low + room.free_high) / 2
        self._half = 0.9 * (room.free_high - room.free_low) / 2 * (1, 1, 0.5)
        a, b = self._half[:2]
        round_length = np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))  # Ramanujan
        self._rounds = max(1, round(duration * speed * TYPICAL_SPEED / round_length))
        self._turns = max(1, round(duration * speed / TURN_DURATION))
        self._phase = float(rng.uniform(0, 2 * np.pi))
        self._direction = float(rng.choice([-1, 1]))
        self._wobble = rng.uniform(0, 2 * np.pi, 3)

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time in seconds; the same at 0 and at `duration`."""
        u = 2 * np.pi * t / self.duration
        angle = self._rounds * u + self._phase
        turns = 7 * self._turns  # of the sway: whole numbers, so that the path closes
        offset = self._half * (np.cos(angle), np.sin(angle), np.sin(2 * angle))
        position = self._centre + offset + 0.01 * np.sin(3 * turns * u + self._wobble)
        yaw = self._phase + self._direction * self._turns * u + 0.25 * np.sin(turns * u + self._wobble[0])
        pitch = -0.15 + 0.15 * np.sin(2 * turns * u + self._wobble[1])
        forward = (np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch))
        roll = 4 * np.sin(turns * u + self._wobble[2])
        return _turned(look_at(position, position + forward, UP), np.array([roll, 0.0, 0.0]))


# ---------------------------------------------------------------- through several rooms


class ClosedWalk:
    """A smooth closed curve through points, by the length walked."""

    def __init__(self, points: np.ndarray) -> None:  # [P, 3] metres
        ring = np.concatenate([points, points[:1]])
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
        curve = CubicSpline(chord, ring, bc_type="periodic")
        fine = np.linspace(0, chord[-1], 200 * len(points))
        steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
        length = np.concatenate([[0.0], np.cumsum(steps)])
        self.length = float(length[-1])  # metres
        self._curve = CubicSpline(length, np.concatenate([curve(fine)[:-1], ring[:1]]), bc_type="periodic")

    def at(self, s: float) -> np.ndarray:  # [3] metres
        """Return the point after `s` metres, of any number of rounds."""
        point: np.ndarray = self._curve(s % self.length)
        return point


class TourPath:
    """Rounds through all rooms at walking pace, looking ahead and to both sides; ends where it began.

    A path too short for half a round goes only so far.
    """

    def __init__(self, room: Room, duration: float, seed: int = 0, speed: float = 1.0) -> None:
        if room.tour is None:
            raise DataError(
                f"path 'tour' walks through several rooms: expected the scene 'flat', got '{room.name}'; "
                "use another scene or path"
            )
        rng = np.random.default_rng([seed, zlib.crc32(room.name.encode()), 2])
        self.duration = duration
        self.walk = ClosedWalk(room.tour)
        rounds = duration * speed * TYPICAL_SPEED / self.walk.length
        self.rounds = rounds if rounds < 0.5 else max(1, round(rounds))
        self._start = float(rng.uniform(0, self.walk.length))
        self._sways = max(1, round(duration * speed / SWAY_PERIOD))  # whole numbers, so that the path closes
        self._phase = rng.uniform(0, 2 * np.pi, 3)

    def walked(self, t: float) -> float:
        """Return the place on the walk in metres at a time in seconds."""
        return self._start + self.rounds * self.walk.length * t / self.duration

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time in seconds; after whole rounds the same at 0 and at `duration`."""
        u = 2 * np.pi * t / self.duration
        s = self.walked(t)
        steps = round(1.8 * self.duration)
        position = self.walk.at(s) + (0, 0, BOB * np.sin(steps * u))
        forward = self.walk.at(s + LOOK_AHEAD) - position
        yaw = np.arctan2(forward[1], forward[0])
        yaw += np.radians(SWAY[0]) * np.sin(self._sways * u + self._phase[0])
        pitch = -0.06 + np.radians(SWAY[1]) * np.sin(2 * self._sways * u + self._phase[1])
        direction = np.array(
            (np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)), np.float64
        )
        return look_at(position, position + direction, UP)


def make_path(room: Room, config: SimulationConfig) -> CameraPath:
    """Return the kind of path that the settings name."""
    if config.path == "tour":
        return TourPath(room, config.duration, config.seed, config.speed)
    if config.path == "loop":
        return LoopPath(room, config.duration, config.seed, config.speed)
    hand_held = HandHeldPath(room, config.duration, config.seed, config.speed)
    if config.path == "rotation":
        return RotationPath(hand_held)
    return StopAndGoPath(hand_held) if config.path == "stop_and_go" else hand_held


def _turned(T: np.ndarray, degrees: np.ndarray) -> np.ndarray:  # [4, 4], [3] roll, pitch, yaw -> [4, 4]
    """Return a pose turned about its own axes."""
    roll, pitch, yaw = np.radians(degrees)
    result = T.copy()
    R = T[:3, :3] @ _axis_rotation(1, yaw) @ _axis_rotation(0, pitch) @ _axis_rotation(2, roll)
    result[:3, :3] = R
    return result


def _axis_rotation(axis: int, angle: float) -> np.ndarray:  # [3, 3]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = np.cos(angle)
    R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
    return R


class RecordedPath:
    """A recorded trajectory, shifted so that its first time stamp is 0."""

    def __init__(
        self,
        trajectory: Trajectory,
        scale: float = 1.0,
        first_pose: np.ndarray | None = None,
        start: float = 0.0,
    ) -> None:
        """Scale positions about the first pose; move the first pose to `first_pose` [4, 4] when given.

        `start` skips seconds of the recording.
        """
        stamps = trajectory.timestamps
        if len(stamps) < 2 or stamps[-1] - stamps[0] <= start:
            length = stamps[-1] - stamps[0] if len(stamps) else 0.0
            raise DataError(
                f"trajectory: expected more than {start:g} s of motion, got {length:g} s; "
                "use a longer trajectory or another start"
            )
        if not 0 < scale < np.inf:
            raise DataError(f"trajectory scale: expected a positive factor, got {scale:g}")
        origin = trajectory.at(stamps[0] + start)
        motion = np.linalg.inv(origin) @ trajectory.poses  # [F, 4, 4]
        motion[:, :3, 3] *= scale
        placed = (origin if first_pose is None else first_pose) @ motion
        farthest = np.abs(placed[:, :3, 3]).max()
        if not farthest <= FARTHEST:
            raise DataError(
                f"trajectory: expected positions within {FARTHEST:g} m, got one {farthest:g} m "
                "away; check its scale"
            )
        self._trajectory = Trajectory(stamps - stamps[0] - start, placed)
        self.duration = float(stamps[-1] - stamps[0] - start)

    def pose(self, t: float) -> np.ndarray:  # [4, 4]
        """Return T_world_camera at a time in seconds."""
        return self._trajectory.at(t)
