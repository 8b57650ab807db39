"""Plain references on held-out motion: models as published, and rigid body with friction by least squares.

Errors are those of ``simgap``'s gain: the same recordings and split, the same window and band, the same unit. All else
is written apart from what ``simgap`` fits: positions low-passed without phase and differentiated by central
differences, Pinocchio's regressor, one linear least squares whose joints are weighted by what is left at them (Gautier,
J. Robotic Systems 14, 1997; Janot, Vandanjon and Gautier, IEEE Trans. Control Syst. Technol. 22, 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import scipy.fft
import scipy.signal

from ident.chain import build_structure
from ident.dataset import Dataset
from ident.group import Group
from ident.held_out import with_held_out
from ident.identification import set_up
from ident.verdict import Diagnosis

CUTOFF = 2.0  # of the low pass of the positions, in multiples of the compared band
ORDER = 4  # of that Butterworth filter, run forth and back
PAD = 3.0  # periods of its cut-off by which a record is prolonged at either end
REWEIGHTINGS = 6
NONE = 1e-9  # of the largest column, below which one says nothing
# singular values over the largest, left out: of what no motion shows; of what this one hardly does
TRUNCATIONS = (1e-6, 1e-2, 3e-2)
EMPS_CUTOFF, EMPS_DECIMATION = 100.0, 10  # Hz, and samples, of the publishers' relative error (their Script_IDIM_LS.m)
EMPS_BORDER = 50  # samples left out there at either end

UR10_LOW_PASS = 2.0  # Hz, about: above it the published recording of the UR10 holds nothing
# figaroh-examples, examples/staubli_TX40 (TX40_config.yaml), joints 1 to 6: Coulomb N m, viscous N m s/rad, motor kg
# m2.
TX40_COULOMB = np.array([7.14, 8.26, 6.34, 2.48, 3.03, 0.28])
TX40_VISCOUS = np.array([8.05, 5.53, 1.97, 1.11, 1.86, 0.65])
TX40_MOTOR = np.array([0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105])
# joints by motors: motor 6 turns by the sum of joints 5 and 6
TX40_WRIST = np.eye(6) - np.outer(np.eye(6)[5], np.eye(6)[4])


@dataclass(frozen=True)
class LinearDrive:
    """A carriage with dry and viscous friction: mass kg, viscous N s/m, Coulomb friction N and offset N."""

    mass: float
    viscous: float
    coulomb: float
    offset: float

    def force(self, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """N, at velocities m/s and accelerations m/s2 of any shape."""
        return self.mass * a + self.viscous * v + self.coulomb * np.sign(v) + self.offset


# Janot, Gautier and Brunot, Data Set and Reference Models of EMPS, 2019 (Simulation_EMPS.m).
EMPS = LinearDrive(mass=95.1089, viscous=203.5034, coulomb=20.3935, offset=-3.1648)


@dataclass(frozen=True)
class Motion:
    """A recorded motion, and what of it is compared.

    Attributes:
        role: "identification" or "validation".
        q, tau: (N, n) positions, rad, and torques, N m.
        t: (N,) s. rate: samples per second.
        rest: (N, n) where a joint stands still.
        window: (N,) weight in time.
        period: samples over which lines are taken; lines are 0 .. ``lines`` - 1.
        low_pass_hz: cut-off of a low pass that the recording has seen before it was published, or None.
    """

    role: str
    q: np.ndarray
    tau: np.ndarray
    t: np.ndarray
    rate: float
    rest: np.ndarray
    window: np.ndarray
    period: int
    lines: int
    low_pass_hz: float | None = None

    @property
    def band_hz(self) -> float:
        """Highest compared frequency, Hz."""
        return (self.lines - 1) * self.rate / self.period

    def seen(self, x: np.ndarray) -> np.ndarray:
        """Signals (N, ...) through window and band: rows of real numbers (2 K - 1, ...) whose squares sum to the mean
        square."""
        weighted = x * self.window.reshape(-1, *[1] * (x.ndim - 1))
        X = scipy.fft.rfft(weighted, n=self.period, axis=0, norm="forward")[: self.lines]
        share = np.sum(self.window**2) / self.period
        return np.concatenate([X.real[:1], np.sqrt(2.0) * X.real[1:], np.sqrt(2.0) * X.imag[1:]]) / np.sqrt(share)

    def rms(self, x: np.ndarray) -> np.ndarray:
        """(n,) root mean square of signals (N, n) in what is compared."""
        return np.sqrt(np.sum(self.seen(x) ** 2, axis=0))


@dataclass(frozen=True)
class Reference:
    """Error of a reference on held-out motion: ``left`` (n,) rms per joint, N m; ``published``: not fitted here."""

    name: str
    left: np.ndarray
    published: bool = False

    @property
    def over_all(self) -> float:
        """Rms over all joints."""
        return float(np.sqrt(np.mean(self.left**2)))


@dataclass(frozen=True)
class References:
    """What a data set's references leave on its held-out motion; ``size`` (n,) is the rms torque itself, N m."""

    joints: tuple[str, ...]
    band_hz: float
    size: np.ndarray
    found: tuple[Reference, ...]

    @property
    def size_over_all(self) -> float:
        """Rms torque over all joints, N m."""
        return float(np.sqrt(np.mean(self.size**2)))

    @property
    def best(self) -> Reference:
        """The one that leaves least over all joints."""
        return min(self.found, key=lambda r: r.over_all)


def motions(dataset: Dataset) -> tuple[Motion, ...]:
    """Motions of a dataset with the window and band in which its diagnosis compares them."""
    dataset = with_held_out(dataset)
    setup = set_up(dataset)
    groups = {group.segments[0]: group for group in (*setup.problem.groups, *setup.held_out)}
    return tuple(_motion(dataset, s.name, groups[s.name]) for s in dataset.segments if s.name in groups)


def _motion(dataset: Dataset, name: str, group: Group) -> Motion:
    (segment,) = (s for s in dataset.segments if s.name == name)
    rate = dataset.sample_rate
    period = round(group.period_time * rate)
    at = np.arange(segment.n_samples) * group.n_time / period
    window = np.interp(at, np.arange(group.n_time), group.window)
    rest = group.rest[0, np.minimum(at.astype(int), group.n_time - 1)]
    return Motion(segment.role, segment.q, segment.tau, segment.t, rate, rest, window, period, group.n_compared)


def low_pass(motion: Motion, cutoff: float) -> np.ndarray:
    """Sections of a Butterworth filter with a cut-off in Hz."""
    return scipy.signal.butter(ORDER, min(2.0 * cutoff / motion.rate, 0.95), output="sos")


def filtered(motion: Motion, cutoff: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration (N, n), low-passed at a cut-off in Hz."""
    pad = min(len(motion.q) - 1, int(PAD * motion.rate / cutoff))
    q = scipy.signal.sosfiltfilt(low_pass(motion, cutoff), motion.q, axis=0, padlen=pad)
    v = np.gradient(q, 1.0 / motion.rate, axis=0)
    return q, v, np.gradient(v, 1.0 / motion.rate, axis=0)


def derivatives(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``filtered`` for the compared band."""
    return filtered(motion, CUTOFF * motion.band_hz)


def columns(model: pin.Model, motion: Motion) -> np.ndarray:
    """(N, n, 10 n + 4 n): torque per inertial parameter, motor inertia, viscous and Coulomb friction, and offset."""
    q, v, a = derivatives(motion)
    data = model.createData()
    each = [pin.computeJointTorqueRegressor(model, data, *x) for x in zip(q, v, a, strict=True)]
    bodies = np.reshape(each, (*q.shape, -1))  # of one joint it comes without its axis
    rubbing = np.sign(v)
    if motion.low_pass_hz is not None:  # of the torques the low pass has rounded off what a velocity turns on at once
        rubbing = scipy.signal.sosfiltfilt(low_pass(motion, motion.low_pass_hz), rubbing, axis=0)
    drives = [x[:, :, None] * np.eye(q.shape[1]) for x in (a, v, rubbing, np.ones_like(v))]
    return np.concatenate([bodies, *drives], axis=2)


def least_squares(y: np.ndarray, X: np.ndarray, truncation: float) -> np.ndarray:
    """Parameters (P,) of torques y (R, n) that are linear in them by X (R, n, P), joints weighted by what is left at
    them.

    Combinations that the motions do not show stay zero: base parameters, by a singular value decomposition.
    """
    scale = np.sqrt(np.mean(y**2, axis=0))
    for _ in range(REWEIGHTINGS):
        A = (X / scale[:, None]).reshape(-1, X.shape[2])
        size = np.linalg.norm(A, axis=0)
        size = np.where(size > NONE * size.max(), size, np.inf)
        p = np.linalg.lstsq(A / size, (y / scale).ravel(), rcond=truncation)[0] / size
        scale = np.maximum(np.sqrt(np.mean((y - X @ p) ** 2, axis=0)), 1e-12 * scale)
    return p


def predicted(motion: Motion, C: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Torque (N, n) by columns (N, n, P) and parameters (P,).

    Where a joint stands still Coulomb friction is what balances the recorded torque, up to its size, as ``simgap`` has
    it: the sign of a velocity says nothing there.
    """
    n = motion.q.shape[1]
    coulomb = slice(len(p) - 2 * n, len(p) - n)
    others = C @ p - C[..., coulomb] @ p[coulomb]
    size = np.abs(p[coulomb])
    return np.where(motion.rest, others + np.clip(motion.tau - others, -size, size), C @ p)


def plain(model: pin.Model, given: Sequence[Motion]) -> tuple[Reference, Reference]:
    """Rigid body with friction, fitted to the motions for identification in the compared band: all of it, and its
    drives alone.

    Short motions show base parameters badly; with the bodies as described there is less to fit, and motor inertia,
    friction and offsets remain. Of several truncations the one that does best on the held-out data themselves is told,
    which favours it.
    """
    train = [(m.seen(m.tau), m.seen(columns(model, m))) for m in given if m.role == "identification"]
    tests = [(m, columns(model, m)) for m in given if m.role == "validation"]
    y, X = (np.concatenate(x) for x in zip(*train, strict=True))
    described = np.concatenate([body.toDynamicParameters() for body in model.inertias.tolist()[1:]])
    none = np.zeros(X.shape[2])
    bodies = np.concatenate([described, none[len(described) :]])

    def left(p: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean([m.rms(m.tau - predicted(m, C, p)) ** 2 for m, C in tests], axis=0))

    def best(name: str, known: np.ndarray, free: slice) -> Reference:
        found = []
        for truncation in TRUNCATIONS:
            p = known.copy()
            p[free] = least_squares(y - X @ known, X[..., free], truncation)
            found.append(Reference(name, left(p)))
        return min(found, key=lambda r: r.over_all)

    return best("least squares", none, slice(None)), best(
        "least squares, bodies as described", bodies, slice(len(described), None)
    )


def evaluated(
    name: str, torque: Callable[[Motion], np.ndarray], given: Sequence[Motion], *, centred: bool = False
) -> Reference:
    """A model as it stands, by its ``torque`` (N, n) along a motion.

    Args:
        centred: offsets of the torque records are taken from the motions for identification.
    """
    errors = [(m, m.tau - torque(m)) for m in given]
    offset = np.mean([e.mean(axis=0) for m, e in errors if m.role == "identification"], axis=0) if centred else 0.0
    held_out = [m.rms(e - offset) ** 2 for m, e in errors if m.role == "validation"]
    return Reference(name, np.sqrt(np.mean(held_out, axis=0)), published=True)


def emps_force(motion: Motion) -> np.ndarray:
    """Force of the publishers' least-squares model of the EMPS, N."""
    _, v, a = derivatives(motion)
    return EMPS.force(v, a)


def emps_relative_error(drive: LinearDrive, motion: Motion) -> float:
    """The publishers' figure of merit, per cent: norm of the error over that of the force, both decimated to 100
    samples a second.

    Positions are low-passed at 100 Hz without phase and differentiated by central differences, as they do.
    """
    _, v, a = filtered(motion, EMPS_CUTOFF)
    pairs = np.concatenate([motion.tau, drive.force(v, a)], axis=1)[EMPS_BORDER:-EMPS_BORDER]
    measured, predicted = scipy.signal.decimate(pairs, EMPS_DECIMATION, axis=0).T
    return float(100.0 * np.linalg.norm(measured - predicted) / np.linalg.norm(measured))


def drive_found(result: Diagnosis) -> LinearDrive | None:
    """The drive that a diagnosis of the EMPS ends with; None where it found more than Coulomb friction."""
    causes, body = result.verdict.causes, build_structure(result.robot).model.inertias[1]
    if {c.effect for c in causes} != {"coulomb_friction"}:
        return None
    (friction,) = (c.parameters for c in causes)
    torque, p = friction["torque"].value, result.parameters
    mass = p["motor_inertia.screw"] + body.mass
    return LinearDrive(mass, p["viscous_friction.screw"], torque, torque * friction["asymmetry"].value)


def tx40_torque(model: pin.Model) -> Callable[[Motion], np.ndarray]:
    """Torque of the TX40 with the bodies of its URDF and the a-priori drives of the publishers' configuration."""

    def torque(motion: Motion) -> np.ndarray:
        q, v, a = derivatives(motion)
        data = model.createData()
        joints = (x @ TX40_WRIST.T for x in (q, v, a))
        bodies = np.array([pin.rnea(model, data, *x) for x in zip(*joints, strict=True)]) @ TX40_WRIST
        return bodies + TX40_MOTOR * a + TX40_VISCOUS * v + TX40_COULOMB * np.sign(v)

    return torque


def tabled_torque(file: Path) -> Callable[[Motion], np.ndarray]:
    """Torque of a published model from a table ``t`` (T,) s, ``torque`` (T, n) N m along a recording.

    For a model whose licence keeps it out of this project: the publishers' own program is run at the ``derivatives`` of
    the recording, and ``published_torque.npz`` beside it holds what comes out. Of the Panda: mass matrix, Coriolis,
    gravity and friction vectors of FrankaEmikaPandaDynModel, matlab/dyn_model_panda, commit 24d85ce.
    """
    with np.load(file) as table:
        t, torque = table["t"], table["torque"]
    return lambda motion: np.stack([np.interp(motion.t, t, x) for x in torque.T], axis=1)


def references(dataset: Dataset, folder: Path) -> References | None:
    """Errors of all references of a data set on its held-out motions; None where it holds no motions.

    Args:
        folder: of the data set; its name says which published model there is.
    """
    if any(s.kind != "trajectory" for s in dataset.segments):
        return None
    given = motions(dataset)
    model = build_structure(dataset.robot).model
    found = [*plain(model, given)]
    if folder.name == "ur10_unisa":
        rounded = plain(model, [replace(m, low_pass_hz=UR10_LOW_PASS) for m in given])
        found += [replace(r, name=f"{r.name}, friction low-passed") for r in rounded]
    if folder.name == "emps_drive":
        found.append(evaluated("publishers' least squares", emps_force, given))
    if folder.name == "staubli_tx40":
        found.append(evaluated("a-priori model", tx40_torque(model), given))
    table = folder / "published_torque.npz"
    if table.is_file():
        found.append(evaluated("published model", tabled_torque(table), given))
        found.append(evaluated("published model with offsets", tabled_torque(table), given, centred=True))
    held_out = [m for m in given if m.role == "validation"]
    size = np.sqrt(np.mean([m.rms(m.tau) ** 2 for m in held_out], axis=0))
    return References(dataset.joints, held_out[0].band_hz, size, tuple(found))
