"""The gray-box model: a flexible-joint arm in Pinocchio, linearised where it was measured.

With motor angles ``q_m`` (n) and link coordinates ``q_a`` (N >= n: the driven joints and every
elastic hinge that no motor turns),

    J q_m'' + f q_m' + T^T tau_s            = u
    M(q_a) q_a'' + c(q_a, q_a') + g(q_a)    = S (tau_s - b q_d') - E (K_e q_e + D_e q_e')
    tau_s = K (T q_m - S^T q_a) + D (T q_m' - S^T q_a'),    q_d = S^T q_a

(Moberg, Oehr and Gunnarsson 2014; Spong 1987 for N = n). ``T`` is the identity unless the gears
couple joints, and ``b`` is zero unless the links have friction of their own. All drive figures are referred to the link
side of the gear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import pinocchio as pin

from ident.chain import Structure
from ident.compliance import link_compliance
from ident.time_steps import TimeSteps, differences
from robot_assets.robot import Robot


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

    def same_as(self, other: Parameters) -> bool:
        """Whether all figures are those of another one."""
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

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


# of a held torque on either side, that drives and sensors may change; each of the next has a seven-hundredth of the
# first at most
IMAGES = 8
# the same, that stiff gears carry to the links; each of the next has a two-hundredth of the first at most
NEAR_IMAGES = 3
STIFF = 0.1  # of a motor on its gear over the sample rate, from which it is no bare inertia to them


def hold_response(omega: np.ndarray, sample_time: float, hold: str) -> np.ndarray:
    """Continuous torque per recorded sample torque: the zero-order hold; (F,) complex.

    ``exp(-j w T / 2) sinc(w T / 2)`` for ``"zoh"``, 1 for ``"none"``.
    """
    if hold == "none":
        return np.ones(len(omega), complex)
    x = omega * sample_time / 2.0
    return np.exp(-1j * x) * np.sinc(x / np.pi)


def alias_response(
    omega: np.ndarray, sample_time: float, hold: str, passed: Callable[[np.ndarray], np.ndarray] | None = None
) -> np.ndarray:
    """Position that the images of a held torque add to a unit inertia in the band; (F,) s2.

    The spectrum of a held torque has images about multiples of the sample rate. Far above its
    resonances every motor is its bare inertia, so what the images add after sampling is that of a
    double integrator: its exact sampled response ``T^2 (z + 1) / (2 (z - 1)^2)`` less its
    baseband part. The error left is of the order of (resonance / sample rate)^2 of this term
    (``stiff_gear_images`` where that is much).

    Args:
        passed: what drives and sensors let pass at complex frequencies (F,), rad/s; (F, n). The result is (F, n) then.
            A current loop that takes a millisecond lets hardly any of the images pass, where it takes little from the
            band.
    """
    if hold == "none":
        return np.zeros(len(omega), complex)
    out = np.zeros(len(omega), complex)
    w = omega[omega > 0]
    z = np.exp(1j * w * sample_time)
    exact = sample_time**2 * (z + 1) / (2 * (z - 1) ** 2)
    out[omega > 0] = exact + hold_response(w, sample_time, hold) / w**2
    if passed is None:
        return out
    image = images_of(omega, sample_time, IMAGES)
    each = -hold_response(image, sample_time, hold) / image**2
    factor = passed(1j * image.ravel()).reshape(*image.shape, -1)
    return out[:, None] + np.einsum("fm,fmn->fn", each, factor - 1.0)


def stiff_gear_images(
    structure: Structure,
    par: Parameters,
    lin: Linearisation,
    omega: np.ndarray,
    sample_time: float,
    hold: str,
    filters: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
) -> np.ndarray | None:
    """What ``alias_response`` lacks where gears are stiff: position per recorded torque that the nearest images add
    beyond that of bare motors; (F, n, n) rad/(N m), or None where all gears are soft to them.

    A gear whose resonance is above the sample rate turns the link at the images too. From ``STIFF`` to twice that it
    counts more and more: a fit that passes by meets no step.

    Args:
        filters: recorded torque per delivered one and true position per measured one at complex frequencies (F,),
            rad/s; (F, n) each.
    """
    stiff = np.sqrt(np.max(par.stiffness / par.inertia, initial=0.0)) * sample_time / (2.0 * np.pi)
    if hold == "none" or stiff <= STIFF:
        return None
    out = np.zeros((len(omega), structure.n, structure.n), complex)
    k = np.arange(structure.n)
    for image in images_of(omega, sample_time, NEAR_IMAGES).T:  # one at a time: all would take several times the room
        Y = np.linalg.inv(impedance(structure, par, lin, 1j * image)[0])
        Y[:, k, k] += 1.0 / (image[:, None] ** 2 * par.inertia)
        Y *= hold_response(image, sample_time, hold)[:, None, None]
        if filters is not None:
            recorded, true = filters(1j * image)
            Y /= true[:, :, None] * recorded[:, None, :]
        out += Y
    return min(stiff / STIFF - 1.0, 1.0) * out


def images_of(omega: np.ndarray, sample_time: float, most: int) -> np.ndarray:
    """(F, 2 most) rad/s, the nearest images of frequencies of a held torque, on either side."""
    order = np.concatenate([np.arange(-most, 0), np.arange(1, most + 1)])
    return omega[:, None] + order * (2 * np.pi / sample_time)


def impedance(
    structure: Structure, par: Parameters, lin: Linearisation, s: np.ndarray, steps: TimeSteps | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torque per motor position of the linearised arm.

    Args:
        s: (F,) complex frequencies, rad/s.
        steps: of a simulation; powers of s below are then its ``differences``.

    Returns:
        Z: (F, n, n) N m/rad, ``s^2 J + s f + T^T (C - C S^T A^{-1} S C) T``.
        A_inv: (F, N, N) inverse of ``s^2 M + s D + K + Kg``, the link side with motors held.
        C: (F, n) spring ``K + s D``.
    """
    n, driven = structure.n, structure.driven
    K = stiffness_diagonal(structure, par)
    D = damping_diagonal(structure, par)
    rate, square = differences(s, steps)
    damped = rate if steps is None else rate + steps.apart * square
    A_inv = link_compliance(lin.M, lin.Kg, K, D, damped, square)
    C = par.stiffness + rate[:, None] * par.damping
    Z = -C[:, :, None] * A_inv[:, driven[:, None], driven] * C[:, None, :]
    k = np.arange(n)
    Z[:, k, k] += C
    Z = par.coupling.T @ Z @ par.coupling
    Z[:, k, k] += square[:, None] * rotor_inertia(par, steps) + rate[:, None] * par.viscous
    return Z, A_inv, C


def rotor_inertia(par: Parameters, steps: TimeSteps | None) -> np.ndarray:
    """(n,) inertia of the motors, kg m2, with what resists beside it in time steps."""
    return par.inertia if steps is None else par.inertia + steps.apart * (par.damping + par.viscous)


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
    more = stiff_gear_images(structure, par, lin, omega, sample_time, hold)
    if more is not None:
        G += (s**2)[:, None, None] * more
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
