"""The gray-box model: a flexible-joint arm in Pinocchio, linearised where it was measured.

With motor angles ``q_m`` (n) and link coordinates ``q_a`` (N >= n: the driven joints and every
elastic hinge that no motor turns),

    J q_m'' + f q_m' + T^T tau_s            = u
    M(q_a) q_a'' + c(q_a, q_a') + g(q_a)    = S (tau_s - b q_d') - E (K_e q_e + D_e q_e')
    tau_s = K (T q_m - S^T q_a) + D (T q_m' - S^T q_a'),    q_d = S^T q_a

(Moberg, Oehr and Gunnarsson 2014; Spong 1987 for N = n). ``T`` is the identity unless the gears
couple joints, and ``b`` is zero unless the links have friction of their own. All drive figures are referred to the link side of the gear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import pinocchio as pin

from robot_assets.errors import DataError
from robot_assets.robot import Elasticity, Robot

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class LinkChange:
    """How the body of a link differs from its description.

    Attributes:
        mass, inertia: factors, the latter on the inertia about the centre of mass.
        com: (3,) shift of the centre of mass in the frame of the link's joint, m.
        with_load: whether the loads that the robot names on it are part of it.
    """

    mass: float = 1.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: float = 1.0
    with_load: bool = False

    def of(self, body: pin.Inertia) -> pin.Inertia:
        """The body with the change made."""
        return pin.Inertia(body.mass * self.mass, body.lever + np.asarray(self.com), body.inertia * self.inertia)

    def __add__(self, other: LinkChange) -> LinkChange:
        """Both changes, one after the other."""
        com = (self.com[0] + other.com[0], self.com[1] + other.com[1], self.com[2] + other.com[2])
        return LinkChange(self.mass * other.mass, com, self.inertia * other.inertia, self.with_load or other.with_load)


@dataclass(frozen=True)
class Structure:
    """What parameters do not change: the chain, and which of its coordinates are driven.

    Attributes:
        model: Pinocchio model over the N link coordinates, loads included.
        driven: (n,) index of each driven joint among the link coordinates.
        elastic: (n_e,) indices of the elastic hinges.
        bodies: link name -> (Pinocchio joint index, placement of the link frame in it).
        carriers: joint of the description -> index of the joint that carries its body, behind its hinges.
        robot: the robot it was built from.
        hinges, loads, links, inertias: what ``build_structure`` was given beyond the robot.
    """

    model: pin.Model
    driven: np.ndarray
    elastic: np.ndarray
    bodies: dict[str, tuple[int, pin.SE3]]
    robot: Robot
    hinges: tuple[Elasticity, ...] = ()
    loads: tuple[tuple[str, pin.Inertia], ...] = ()
    links: dict[str, LinkChange] = field(default_factory=dict)
    inertias: dict[str, pin.Inertia] = field(default_factory=dict)
    carriers: dict[str, int] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of motors."""
        return len(self.driven)

    @property
    def n_coordinates(self) -> int:
        """Number of link coordinates N."""
        return self.model.nv


@dataclass(frozen=True)
class Parameters:
    """The baseline parameters, SI, link side of the gear.

    Attributes:
        stiffness: (n,) gear stiffness, N m/rad.
        damping: (n,) damping in parallel with it, N m s/rad.
        inertia: (n,) motor inertia, kg m2.
        viscous: (n,) viscous friction of the motor, N m s/rad.
        elastic_stiffness: (n_e,) stiffness of the elastic hinges, N m/rad.
        elastic_damping: (n_e,) their damping, N m s/rad.
        timing: common delay of the torque channel against the position channel that the sampling
            model does not know of, s (a fraction of a sample).
        coupling: (n, n) T of the module docstring.
        link_viscous: (n,) viscous friction of the driven links, b of the module docstring, N m s/rad.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    inertia: np.ndarray
    viscous: np.ndarray
    elastic_stiffness: np.ndarray
    elastic_damping: np.ndarray
    timing: float
    coupling: np.ndarray
    link_viscous: np.ndarray

    @classmethod
    def nominal(cls, robot: Robot) -> Parameters:
        """The starting guesses of ``robot.toml``."""
        return cls(
            stiffness=robot.array("stiffness").copy(),
            damping=robot.array("damping").copy(),
            inertia=robot.array("motor_inertia").copy(),
            viscous=robot.array("viscous_friction").copy(),
            elastic_stiffness=np.array([e.stiffness for e in robot.elasticities], float),
            elastic_damping=np.array([e.damping for e in robot.elasticities], float),
            timing=0.0,
            coupling=np.eye(robot.n),
            link_viscous=np.zeros(robot.n),
        )

    def to_log(self) -> np.ndarray:
        """(4 n + 2 n_e,) logarithms in the order stiffness, damping, inertia, viscous, elastic."""
        return np.log(
            np.concatenate(
                [
                    self.stiffness,
                    self.damping,
                    self.inertia,
                    self.viscous,
                    self.elastic_stiffness,
                    self.elastic_damping,
                ]
            )
        )

    def with_log(self, x: np.ndarray) -> Parameters:
        """A copy with the positive parameters taken from ``to_log`` order."""
        n, e = len(self.stiffness), len(self.elastic_stiffness)
        parts = np.split(np.exp(x), np.cumsum([n, n, n, n, e]))
        return replace(
            self,
            stiffness=parts[0],
            damping=parts[1],
            inertia=parts[2],
            viscous=parts[3],
            elastic_stiffness=parts[4],
            elastic_damping=parts[5],
        )


def parameter_names(robot: Robot) -> tuple[str, ...]:
    """Names in the order of ``Parameters.to_log``: ``stiffness.<joint>`` and so on."""
    kinds = ("stiffness", "damping", "motor_inertia", "viscous_friction")
    names = [f"{kind}.{joint}" for kind in kinds for joint in robot.joint_names]
    names += [f"{kind}.{e.name}" for kind in kinds[:2] for e in robot.elasticities]
    return tuple(names)


INERTIAL = (
    "mass",
    *(f"first_moment_{i}" for i in "xyz"),
    *(f"inertia_{ij}" for ij in ("xx", "xy", "yy", "xz", "yz", "zz")),
)
"""Inertial parameters of a body in the frame of its joint, in the order of ``pin.Inertia.toDynamicParameters``."""


def _placed_loads(robot: Robot, source: pin.Model) -> list[tuple[str, pin.Inertia]]:
    """Loads that a robot names, each with its link, in the frame of the joint that carries that."""
    places = {f.name: f.placement for f in source.frames if f.type == pin.FrameType.BODY}
    for load in robot.loads:
        if load.link not in places:
            raise DataError("load", str(robot.folder), load.link, f"a link among {sorted(places)}")
    return [
        (load.link, places[load.link].act(pin.Inertia(load.mass, np.asarray(load.com), np.asarray(load.inertia))))
        for load in robot.loads
    ]


def build_structure(
    robot: Robot,
    *,
    elasticities: tuple[Elasticity, ...] = (),
    loads: tuple[tuple[str, pin.Inertia], ...] = (),
    links: dict[str, LinkChange] | None = None,
    inertias: dict[str, pin.Inertia] | None = None,
) -> Structure:
    """Pinocchio chain of a robot, with elastic hinges and loads placed.

    Args:
        robot: the arm.
        elasticities: elastic hinges beyond those of the robot.
        loads: (link name, inertia in that link's frame) beyond those of the robot.
        links: link name -> how its body differs from its description.
        inertias: joint of the description -> inertia of the body on it, loads of the robot included, instead
            of what the description says.

    Raises:
        DataError: where the URDF lacks a joint or link that the robot names, or holds a joint
            that is neither driven nor locked.
    """
    source = _reduced_model(robot)
    hinges = robot.elasticities + tuple(elasticities)
    model = pin.Model()
    model.name = robot.name
    model.gravity.linear = np.asarray(robot.gravity, float)
    parent = {f.name: f.parentJoint for f in source.frames if f.type == pin.FrameType.BODY}
    changed = {parent[link]: change for link, change in (links or {}).items()}
    known = inertias or {}
    placed = _placed_loads(robot, source)
    carrier = {0: _add_hinges(model, 0, [h for h in hinges if h.joint == "base"], pin.SE3.Identity())[0]}
    if carrier[0]:  # on a foundation that moves the root link moves with it
        model.appendBodyToJoint(carrier[0], source.inertias[0], pin.SE3.Identity())
    index: dict[str, int] = {}
    for i in range(1, source.njoints):
        name, joint = source.names[i], source.joints[i]
        own = [h for h in hinges if h.joint == name]
        below, placement = _add_hinges(
            model, carrier[source.parents[i]], [h for h in own if h.before], source.jointPlacements[i]
        )
        k = model.addJoint(below, _joint_model(joint), placement, name)
        index[name] = model.idx_vs[k]
        carrier[i], _ = _add_hinges(model, k, [h for h in own if not h.before], pin.SE3.Identity())
        body, change = known.get(name, source.inertias[i]), changed.get(i, LinkChange())
        if change.with_load and name not in known:
            body = sum((x for link, x in placed if parent[link] == i), body)
        model.appendBodyToJoint(carrier[i], change.of(body), pin.SE3.Identity())
    bodies = {
        f.name: (carrier[f.parentJoint], f.placement)
        for f in source.frames
        if f.type == pin.FrameType.BODY
    }
    for link, inertia in placed:
        if source.names[parent[link]] not in known and not changed.get(parent[link], LinkChange()).with_load:
            model.appendBodyToJoint(bodies[link][0], inertia, pin.SE3.Identity())
    for link, inertia in loads:
        if link not in bodies:
            raise DataError("load", str(robot.folder), link, f"a link among {sorted(bodies)}")
        joint_index, placement = bodies[link]
        model.appendBodyToJoint(joint_index, inertia, placement)
    driven = np.array([index[name] for name in robot.joint_names])
    elastic = np.array(
        [model.idx_vs[model.getJointId(_hinge_name(h))] for h in hinges], dtype=int
    )
    return Structure(
        model,
        driven,
        elastic,
        bodies,
        robot,
        tuple(elasticities),
        tuple(loads),
        dict(links or {}),
        dict(known),
        {source.names[i]: k for i, k in carrier.items() if i},
    )


def equilibrium(structure: Structure, par: Parameters, q_m: np.ndarray) -> np.ndarray:
    """Link coordinates at rest under gravity, motors held at ``q_m``; (N,) rad.

    Newton on ``g(q_a) = S K (T q_m - S^T q_a) - E K_e q_e``; it depends on the parameters, as the
    sag of the springs does (Wernholt and Moberg 2011, Sec. 2.1).
    """
    model, data = structure.model, structure.model.createData()
    stiffness = stiffness_diagonal(structure, par)
    rest = np.zeros(model.nv)
    rest[structure.driven] = par.coupling @ q_m
    q = rest.copy()
    for _ in range(50):
        g = pin.computeGeneralizedGravity(model, data, q)
        slope = pin.computeGeneralizedGravityDerivatives(model, data, q)
        step = np.linalg.solve(slope + np.diag(stiffness), stiffness * (rest - q) - g)
        q = q + step
        if np.max(np.abs(step)) < 1e-13:
            break
    return q


@dataclass(frozen=True)
class Linearisation:
    """Second-order matrices of the link side at one equilibrium.

    Attributes:
        q: (N,) link coordinates, rad.
        M: (N, N) inertia matrix, kg m2.
        Kg: (N, N) slope of the gravity torque, N m/rad.
        g: (N,) gravity torque, N m.
    """

    q: np.ndarray
    M: np.ndarray
    Kg: np.ndarray
    g: np.ndarray


def linearise(structure: Structure, q: np.ndarray) -> Linearisation:
    """Inertia, gravity and gravity slope of the link side at ``q`` (N,), at rest."""
    model, data = structure.model, structure.model.createData()
    M = pin.crba(model, data, q)
    k = np.arange(len(M))
    M = np.where(k[:, None] <= k, M, M.T)
    slope = np.array(pin.computeGeneralizedGravityDerivatives(model, data, q))
    return Linearisation(q, M, slope, np.array(pin.computeGeneralizedGravity(model, data, q)))


def stiffness_diagonal(structure: Structure, par: Parameters) -> np.ndarray:
    """(N,) spring stiffness of each link coordinate, N m/rad."""
    out = np.zeros(structure.n_coordinates)
    out[structure.driven] = par.stiffness
    out[structure.elastic] = par.elastic_stiffness
    return out


def damping_diagonal(structure: Structure, par: Parameters) -> np.ndarray:
    """(N,) damping of each link coordinate with motors held, N m s/rad: its spring's and its own."""
    out = np.zeros(structure.n_coordinates)
    out[structure.driven] = par.damping + par.link_viscous
    out[structure.elastic] = par.elastic_damping
    return out


def hold_response(omega: np.ndarray, sample_time: float, hold: str) -> np.ndarray:
    """Continuous torque per recorded sample torque: the zero-order hold; (F,) complex.

    ``exp(-j w T / 2) sinc(w T / 2)`` for ``"zoh"``, 1 for ``"none"``.
    """
    if hold == "none":
        return np.ones(len(omega), complex)
    x = omega * sample_time / 2.0
    return np.exp(-1j * x) * np.sinc(x / np.pi)


def alias_response(omega: np.ndarray, sample_time: float, hold: str) -> np.ndarray:
    """Position that the images of a held torque add to a unit inertia in the band; (F,) s2.

    The spectrum of a held torque has images about multiples of the sample rate. Far above its
    resonances every motor is its bare inertia, so what the images add after sampling is that of a
    double integrator: its exact sampled response ``T^2 (z + 1) / (2 (z - 1)^2)`` less its
    baseband part. The error left is of the order of (resonance / sample rate)^2 of this term.
    """
    if hold == "none":
        return np.zeros(len(omega), complex)
    out = np.zeros(len(omega), complex)
    w = omega[omega > 0]
    z = np.exp(1j * w * sample_time)
    exact = sample_time**2 * (z + 1) / (2 * (z - 1) ** 2)
    out[omega > 0] = exact + hold_response(w, sample_time, hold) / w**2
    return out


def impedance(
    structure: Structure, par: Parameters, lin: Linearisation, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torque per motor position of the linearised arm.

    Args:
        s: (F,) complex frequencies, rad/s.

    Returns:
        Z: (F, n, n) N m/rad, ``s^2 J + s f + T^T (C - C S^T A^{-1} S C) T``.
        A_inv: (F, N, N) inverse of ``s^2 M + s D + K + Kg``, the link side with motors held.
        C: (F, n) spring ``K + s D``.
    """
    n, driven = structure.n, structure.driven
    K = stiffness_diagonal(structure, par)
    D = damping_diagonal(structure, par)
    A = s[:, None, None] ** 2 * lin.M + lin.Kg
    diag = np.arange(structure.n_coordinates)
    A[:, diag, diag] += K + s[:, None] * D
    A_inv = np.linalg.inv(A)
    C = par.stiffness + s[:, None] * par.damping
    Z = -C[:, :, None] * A_inv[:, driven[:, None], driven] * C[:, None, :]
    k = np.arange(n)
    Z[:, k, k] += C
    Z = par.coupling.T @ Z @ par.coupling
    Z[:, k, k] += s[:, None] ** 2 * par.inertia + s[:, None] * par.viscous
    return Z, A_inv, C


def sampled_frf(
    structure: Structure,
    par: Parameters,
    lin: Linearisation,
    frequency: np.ndarray,
    sample_time: float,
    hold: str,
    *,
    derivatives: bool = False,
) -> tuple[np.ndarray, np.ndarray | None]:
    """FRF from recorded motor torque to sampled motor acceleration ``(j w)^2 q``.

    Args:
        lin: at one posture, or with M and Kg (F, N, N), one for each frequency.
        frequency: (F,) Hz, above zero and below Nyquist.
        derivatives: also return the derivative by each entry of ``Parameters.to_log`` and, last,
            by ``timing``.

    Returns:
        G: (F, n, n) (rad/s2)/(N m).
        dG: (F, n, n, n_theta) or None.
    """
    omega = 2 * np.pi * np.asarray(frequency, float)
    s = 1j * omega
    Z, A_inv, C = impedance(structure, par, lin, s)
    H0 = hold_response(omega, sample_time, hold) * np.exp(-s * par.timing)
    alias = alias_response(omega, sample_time, hold)
    Y = np.linalg.inv(Z)
    k = np.arange(structure.n)
    gain = (H0 * s**2)[:, None, None]
    G = gain * Y
    G[:, k, k] += (s**2 * alias)[:, None] / par.inertia
    if not derivatives:
        return G, None
    left, right = impedance_derivatives(structure, par, s, A_inv, C)
    # Laid out with the columns of G first: an FRF is stacked by columns.
    rows, columns, n = gain * (Y @ left), np.swapaxes(right @ Y, 1, 2), structure.n
    dG = np.empty((len(s), n, n, left.shape[2] + 1), complex)
    np.multiply(columns[:, :, None], -rows[:, None], out=dG[..., :-1])
    dG[:, k, k, 2 * n + k] -= (s**2 * alias)[:, None] / par.inertia
    dG[..., -1] = np.swapaxes((-s)[:, None, None] * gain * Y, 1, 2)
    return G, np.swapaxes(dG, 1, 2)


def spring_deflections(
    structure: Structure, par: Parameters, A_inv: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Deflection of each gear spring (F, n, n) and each elastic hinge (F, n_e, n) per motor position.

    Their transposes are torque per pseudo-torque.
    """
    n, driven = structure.n, structure.driven
    held = -A_inv[:, :, driven] * C[:, None, :]
    deflection = held[:, driven]
    deflection[:, np.arange(n), np.arange(n)] += 1.0
    return deflection @ par.coupling, -held[:, structure.elastic] @ par.coupling


def impedance_derivatives(
    structure: Structure, par: Parameters, s: np.ndarray, A_inv: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of the impedance by the log-parameters, each of rank one.

    ``dZ/dtheta_p = left[:, :, p] right[:, p, :]`` (theory: a spring changes the stiffness matrix
    by ``a a^T``, so every derivative of its inverse is an outer product).

    Returns:
        left: (F, n, n_theta), right: (F, n_theta, n).
    """
    eye = np.broadcast_to(np.eye(structure.n), (len(s), structure.n, structure.n))
    deflection, hinge = spring_deflections(structure, par, A_inv, C)
    one = s[:, None, None] * np.ones((1, 1, 1))
    right = np.concatenate(
        [
            par.stiffness[:, None] * deflection,
            one * par.damping[:, None] * deflection,
            one**2 * par.inertia[:, None] * eye,
            one * par.viscous[:, None] * eye,
            par.elastic_stiffness[:, None] * hinge,
            one * par.elastic_damping[:, None] * hinge,
        ],
        axis=1,
    )
    plain = [deflection, deflection, eye, eye, hinge, hinge]
    left = np.concatenate([np.swapaxes(x, 1, 2) for x in plain], axis=2)
    return left, right


def _reduced_model(robot: Robot) -> pin.Model:
    """The rigid chain of a robot's driven joints; a file is read once, as long as it stays the same."""
    changed = robot.urdf.stat().st_mtime_ns if robot.urdf.exists() else 0
    locked = tuple(sorted((name, float(angle)) for name, angle in robot.locked.items()))
    return _read_chain(str(robot.urdf), changed, robot.joint_names, locked, str(robot.folder))


@lru_cache(maxsize=8)
def _read_chain(
    urdf: str, changed: int, joint_names: tuple[str, ...], locked: tuple[tuple[str, float], ...], folder: str
) -> pin.Model:
    try:
        full = pin.buildModelFromUrdf(urdf)
    except Exception as err:
        raise DataError("URDF", urdf, str(err).splitlines()[0], "a readable URDF") from err
    movable = set(full.names[1:])
    missing = [name for name in joint_names if name not in movable]
    if missing:
        raise DataError("joint", urdf, f"no {missing[0]}", f"one of {sorted(movable)}")
    angles = dict(locked)
    free = movable - set(joint_names)
    stray = sorted(free - set(angles))
    if stray:
        raise DataError("joint", folder, f"{stray[0]} neither driven nor locked", "a [locked] entry")
    q = pin.neutral(full)
    for name in free:
        joint = full.joints[full.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = (
            [np.cos(angles[name]), np.sin(angles[name])] if joint.nq == 2 else [angles[name]]
        )
    return pin.buildReducedModel(full, [full.getJointId(name) for name in free], q)


def _joint_model(joint: pin.JointModel) -> pin.JointModel:
    """The same axis as a joint of one coordinate (a URDF "continuous" joint has two)."""
    kind = joint.shortname()
    prismatic = "JointModelP" in kind
    axis = np.asarray(
        joint.extract().axis if "Unaligned" in kind else _AXES.get(kind[-1], (0.0, 0.0, 0.0)), float
    )
    if not np.any(axis):
        raise DataError("joint", kind, "a joint of several degrees of freedom", "revolute or prismatic")
    return pin.JointModelPrismaticUnaligned(axis) if prismatic else pin.JointModelRevoluteUnaligned(axis)


def _hinge_name(hinge: Elasticity) -> str:
    return f"elasticity:{hinge.name}"


def _add_hinges(
    model: pin.Model, parent: int, hinges: Sequence[Elasticity], placement: pin.SE3
) -> tuple[int, pin.SE3]:
    """The last of a chain of hinges, and where it takes what comes after them."""
    for hinge in hinges:
        axis = np.asarray(hinge.axis, float)
        revolute = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        parent = model.addJoint(parent, revolute, placement, _hinge_name(hinge))
        placement = pin.SE3.Identity()
    return parent, placement
