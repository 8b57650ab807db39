"""FRF matching against prediction errors, local and nonlinear, and against fits by simulation.

One MuJoCo data set an arm, effect-free, drives off nominal by up to two; all methods start from the same drives, off
the true ones by up to two, and fit stiffness, damping, motor inertia and friction of every joint:

- WLLS on FRFs, their estimation included;
- local PEM: stationary Kalman predictor at each operating point, noise estimated;
- EKF-PEM: extended Kalman filter on the whole nonlinear arm, noise estimated;
- particle filter: bootstrap filter, common random numbers, information from the EKF, a few steps of scoring from drives
  ``NEAR`` off the WLLS estimate;
- MuJoCo output error: the closed loop simulated with the controller known, torques and positions compared;
- mujoco.sysid: rollouts of the recorded torque, steadied by a servo to the recorded motion, as an arm that gravity or
  drift would carry off needs. Its own optimiser, with log-parameters.

"late": from the first WLLS estimate instead, for prediction errors have local minima. Seconds are of processor,
compilation left out, and the median over the starts. A start has converged where every spring ends within 5 % of the
truth and every damper within 50 %; errors are over those starts, or over all, marked "all", where none has. No fit
takes more than ``LIMIT`` steps, each a Jacobian by differences; "cut" counts those that were stopped by it. Evaluations
are runs of the predictor or of the simulation over all the data, the median over the starts.

    python benchmarks/bench_prediction.py [--full] [--arms twomass pair ur10 irb]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from bench_estimators import draw, fitted_case, frf_case
from provenance import commit
from scipy.optimize import least_squares

from ident.chain import Structure, build_structure
from ident.dataset import Dataset
from ident.estimate import fit_frf
from ident.excitation import operating_points
from ident.filters import extended_kalman, particle_filter
from ident.frf import estimate_frf
from ident.graybox import Parameters, parameter_names
from ident.kalman import local_predictor
from ident.predict import Noise, PredictionFit, Predictor, Runs, fit_prediction, runs_of
from robot_assets.errors import DataError
from robot_assets.robot import Robot, load_robot
from sim import run_experiment
from sim.experiment import draw_drives, loop_gains, plan_experiment
from sim.loop import Controller, run_loop
from sim.loop import Noise as LoopNoise
from sim.plant import DRIVE_FIELDS, build_plant, build_spec, link_inertia_diagonal, rest

STEP = 1e-3  # s, of the simulations that are fitted, RK4; the data are of 0.25 ms
SPRINGS, DAMPERS = 0.05, 0.5  # relative errors within which a start counts as converged
RANGE = np.log(8.0)  # bounds of the fits by simulation, about their start
PARTICLES = 100
LIMIT = 30  # steps of a fit by prediction errors or by simulation
ARMS = ("twomass", "pair", "ur10", "irb")
NEAR = 0.01  # start of the particle filter, in log-parameters about the WLLS estimate


@dataclass(frozen=True)
class End:
    """Where a fit ended.

    Attributes:
        parameters: there. evaluations: runs over all the data. cut: whether ``LIMIT`` ended it.
        fit: with the noise, of prediction errors.
    """

    parameters: Parameters
    evaluations: int | None = None
    cut: bool = False
    fit: PredictionFit | None = None


@dataclass(frozen=True)
class Case:
    """An arm, its data and the truth."""

    title: str
    robot: Robot
    structure: Structure
    data: Dataset
    runs: Runs
    truth: np.ndarray
    starts: tuple[Parameters, ...]


def pair() -> Robot:
    """Shoulder lift and elbow of the UR10 with its load, the other joints locked."""
    robot = load_robot("ur10")
    keep = ("shoulder_lift_joint", "elbow_joint")
    k = [robot.joint_names.index(name) for name in keep]
    locked = {name: 0.3 for name in robot.joint_names if name not in keep}
    return replace(
        robot, joints=tuple(robot.joints[i] for i in k), locked=locked, q_min=robot.q_min[k], q_max=robot.q_max[k]
    )


def make_case(
    title: str,
    robot: Robot,
    starts: int,
    *,
    level: float,
    points: int = 1,
    period: int = 1000,
    high: float = 70.0,
    seed: int = 1,
) -> Case:
    """Simulate: one realization at each point, one transient period and two that count."""
    rng = np.random.default_rng(seed)
    postures = operating_points(robot, points, rng)
    plan = plan_experiment(
        robot,
        postures,
        points=points,
        validation_points=0,
        levels=(level,),
        period=period,
        periods=3,
        trajectory=False,
        seed=seed,
        band_hz=(0.4, high),
    )
    drives = draw_drives(rng, robot)
    data = run_experiment(plan, drives=drives, seed=seed)
    nominal = Parameters.nominal(robot)
    truth = nominal.to_log()
    truth[: 4 * robot.n] = np.log(np.concatenate([drives[f] for f in DRIVE_FIELDS]))
    off = rng.uniform(-np.log(2), np.log(2), (starts, len(truth)))
    return Case(
        title,
        robot,
        build_structure(robot),
        data,
        runs_of(data),
        truth,
        tuple(nominal.with_log(truth + d) for d in off),
    )


def first_noise(case: Case) -> Noise:
    """Where noise estimates begin: 5 % of the torque, and the encoder of the description."""
    return Noise(0.05 * case.runs.u.std(axis=(0, 1)), case.robot.array("q_std"))


def wlls(case: Case, start: Parameters) -> End:
    frf = estimate_frf(case.data)
    return End(
        fit_frf(
            case.structure,
            frf,
            start,
            sample_time=case.runs.sample_time,
            hold="zoh",
            starts=(start,),
            fitted=parameter_names(case.robot),
        ).parameters
    )


def pem(case: Case, predictor: Predictor, start: Parameters, **options) -> End:
    options = {"steps": LIMIT} | options
    fit = fit_prediction(predictor, case.structure, start, first_noise(case), **options)
    return End(fit.parameters, fit.evaluations, not fit.converged, fit)


def particles(case: Case, start: Parameters) -> End:
    predictor, guide = (
        particle_filter(case.structure, case.runs, particles=PARTICLES),
        extended_kalman(case.structure, case.runs),
    )
    return pem(case, predictor, start, guide=guide, steps=6, promise=10.0)


def drives_of(x: np.ndarray) -> dict[str, np.ndarray]:
    """Log-parameters as true drive figures of a plant."""
    return dict(zip(DRIVE_FIELDS, np.exp(x).reshape(4, -1), strict=True))


def output_error(case: Case) -> Callable[[Parameters], End]:
    """Fit by the closed loop simulated in MuJoCo, weighted by what two periods of the record differ by."""
    segments, robot = case.data.select(role="identification", kind="multisine"), case.robot
    q0 = np.stack([s.q0 for s in segments])
    r = np.stack([s.r for s in segments])
    true = build_plant(robot, drives=drives_of(case.truth))
    kp, kd = (np.stack(g) for g in zip(*(loop_gains(link_inertia_diagonal(true, q)) for q in q0), strict=True))
    loop = Controller(kp, np.zeros_like(kp), kd, np.stack([rest(true, q)[1] for q in q0]))
    silent = LoopNoise(*np.zeros((3, robot.n)))
    skip, samples = case.runs.skip, r.shape[1]
    half = (samples - skip) // 2
    signals = [x[:, skip:] for x in (case.runs.u, case.runs.y)]
    sizes = [np.std(x[:, :half] - x[:, half:], axis=(0, 1)) for x in signals]

    looks = 0

    def residual(x: np.ndarray) -> np.ndarray:
        nonlocal looks
        looks += 1
        plant = build_plant(robot, drives=drives_of(x), timestep=STEP)
        start = np.stack([rest(plant, q)[0] for q in q0])
        run = run_loop(
            plant,
            start,
            q0[:, None],
            r,
            samples,
            loop,
            silent,
            case.data.sample_rate,
            np.random.default_rng(0),
            np.zeros(len(q0)),
        )
        e = [(a - b[:, skip:]) / s for a, b, s in zip(signals, (run.tau, run.q), sizes, strict=True)]
        return np.clip(np.nan_to_num(np.concatenate([x.ravel() for x in e]), nan=1e6), -1e6, 1e6)

    def fit(start: Parameters) -> End:
        nonlocal looks
        x, looks = start.to_log(), 0
        found = least_squares(residual, x, bounds=(x - RANGE, x + RANGE), diff_step=1e-6, max_nfev=LIMIT)
        return End(start.with_log(found.x), looks, found.status == 0)

    return fit


def peer(case: Case) -> Callable[[Parameters], End] | None:
    """Fit by mujoco.sysid; None where it is not installed."""
    try:
        from mujoco.sysid import (
            ModelSequences,
            Parameter,
            ParameterDict,
            TimeSeries,
            build_residual_fn,
            create_initial_state,
            optimize,
        )
    except ImportError:
        return None
    runs, robot = case.runs, case.robot
    times, sigma = np.arange(runs.u.shape[1]) * STEP, robot.array("q_std")
    # What the servo is held to is constant over a step: the middle of the step, and the mean velocity over it.
    after = np.concatenate([runs.y[:, 1:], runs.y[:, -1:]], axis=1)
    middle, velocity = 0.5 * (runs.y + after), (after - runs.y) / STEP

    def servoed(x: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> mujoco.MjSpec:
        spec = build_spec(robot, drives=drives_of(x), timestep=STEP)
        for prefix in ("torque", "servo"):
            for j, name in enumerate(robot.joint_names):
                act = spec.add_actuator(
                    name=f"{prefix}:{name}", target=f"motor:{name}", trntype=mujoco.mjtTrn.mjTRN_JOINT
                )
                if prefix == "torque":
                    act.set_to_motor()
                else:
                    act.set_to_position(kp=kp[j], kv=kd[j])
        for name in robot.joint_names:
            spec.add_sensor(
                name=f"q:{name}",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=f"motor:{name}",
            )
        return spec

    def setter(kind: str, name: str) -> Callable[[mujoco.MjSpec, Parameter], None]:
        def put(spec: mujoco.MjSpec, p: Parameter) -> None:
            value = float(np.exp(p.value[0]))
            gear, motor = spec.tendon(f"gear:{name}"), spec.joint(f"motor:{name}")
            if kind == "stiffness":
                gear.stiffness = [value, 0, 0]
            elif kind == "damping":
                gear.damping = [value, 0, 0]
            elif kind == "motor_inertia":
                motor.armature = value
            else:
                motor.damping = [value, 0, 0]

        return put

    motors = build_plant(robot).motor

    def difference(params, predicted, measured, model, return_all, state=None, sensor_weights=None):
        # Row k of the state is after step k: position k + 1 of the record.
        e = (state[runs.skip - 1 :, 1 + motors] - measured.data[runs.skip :]) / sigma
        return np.clip(np.nan_to_num(e, nan=1e9), -1e9, 1e9), measured, measured

    def fit(start: Parameters) -> End:
        x = start.to_log()
        sequences = []
        for p, q0 in enumerate(runs.q0):
            plant = build_plant(robot, drives=drives_of(x))
            kp, kd = loop_gains(link_inertia_diagonal(plant, q0))
            spec = servoed(x, kp, kd)
            model, mine = spec.compile(), np.flatnonzero(runs.point == p)
            state = create_initial_state(model, rest(plant, q0)[0])
            mapping = TimeSeries.compute_all_sensor_mapping(model)
            sequences.append(
                ModelSequences(
                    f"point {p}",
                    spec,
                    [f"run {r}" for r in mine],
                    [state] * len(mine),
                    [
                        TimeSeries(times, np.concatenate([runs.u[r] + kd * velocity[r], middle[r]], axis=1))
                        for r in mine
                    ],
                    [TimeSeries(times, runs.y[r], mapping) for r in mine],
                )
            )
        params = ParameterDict()
        for i, (kind, name) in enumerate((kind, name) for kind in DRIVE_FIELDS for name in robot.joint_names):
            params[f"{kind}.{name}"] = Parameter(
                f"{kind}.{name}", x[i], x[i] - RANGE, x[i] + RANGE, modifier=setter(kind, name)
            )
        inner = build_residual_fn(
            models_sequences=sequences, modify_residual=difference, resample_true=False, n_threads=1
        )
        looks, steps = 0, 0

        def residual(x: np.ndarray, params: ParameterDict, **options):
            nonlocal looks
            looks += 1 if x.ndim == 1 else x.shape[1]  # a column a difference
            return inner(x, params, **options)

        def count(trace: list) -> None:
            nonlocal steps
            steps = len(trace)

        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = optimize(
                params, residual, optimizer="mujoco", verbose=False, max_iters=LIMIT, iter_callback=count
            )
        return End(start.with_log(found.as_vector()), looks, steps == LIMIT)

    return fit


def timed(fit: Callable[[Parameters], End], starts: Sequence[Parameters]) -> tuple[list[End | None], list[float]]:
    """(ends, None for a failure; seconds of processor) from every start."""
    out: list[End | None] = []
    seconds = []
    for start in starts:
        began = time.process_time()
        try:
            out.append(fit(start))
        except DataError:
            out.append(None)
        seconds.append(time.process_time() - began)
    return out, seconds


def table(case: Case, *, filtered: bool = True, chance: bool = False, simulated: bool = True) -> None:
    """Print a row a method."""
    runs, n = case.runs, case.robot.n
    print(
        f"{case.title}: {len(runs.u)} experiments x {runs.u.shape[1]} samples, {len(case.truth)} parameters, {len(case.starts)} starts"
    )
    print(
        "method                     springs: median    worst   dampers: median    worst   converged   CPU s   x WLLS   evaluations   cut"
    )
    base = None

    def row(name: str, ends: list[End | None], seconds: list[float]) -> None:
        nonlocal base
        base = base or float(np.median(seconds))
        ended = [e for e in ends if e is not None]
        errors = np.abs(np.expm1(np.array([e.parameters.to_log() - case.truth for e in ended]).reshape(-1, 4, n)))
        good = (errors[:, 0].max(axis=1) < SPRINGS) & (errors[:, 1].max(axis=1) < DAMPERS)
        shown = errors[good] if good.any() else errors
        cells = [
            f"{np.median(e):8.1e}   {e.max():6.1e}" if len(ended) else "       -        -"
            for e in (shown[:, 0], shown[:, 1])
        ]
        count = [e.evaluations for e in ended if e.evaluations is not None]
        print(
            f"{name:26s}        {cells[0]}          {cells[1]}   {good.sum():5d}/{len(ends)} {' ' if good.any() else 'all'}"
            f" {np.median(seconds):7.2f}   {np.median(seconds) / base:6.0f}"
            + (f"   {np.median(count):11.0f}   {sum(e.cut for e in ended):3d}" if count else ""),
            flush=True,
        )

    def both(name: str, fit: Callable[[Parameters], End]) -> End | None:
        row(name, *timed(fit, case.starts))
        late, seconds = timed(fit, [first])
        row(f"{name}, late", late, seconds)
        return late[0]

    wlls(case, case.starts[0])
    matched, seconds = timed(lambda s: wlls(case, s), case.starts)
    row("WLLS on FRFs", matched, seconds)
    if matched[0] is None:
        raise DataError(
            "WLLS", case.title, "a failure at the first start", "an estimate that the others can begin with"
        )
    first = matched[0].parameters

    def predicted(name: str, make: Callable[[Structure, Runs], Predictor]) -> End | None:
        predictor = make(case.structure, runs)
        predictor(case.starts[0], first_noise(case))
        return both(name, lambda s: pem(case, predictor, s))

    predicted("local PEM", local_predictor)
    if simulated:
        other = peer(case)
        if other is None:
            print("mujoco.sysid               skipped: not installed (pip install mujoco[sysid])")
        else:
            both("mujoco.sysid", other)
        both("MuJoCo output error", output_error(case))
    late = predicted("EKF-PEM", extended_kalman) if filtered else None
    if chance and late is not None:
        few = replace(runs, u=runs.u[:, :2], y=runs.y[:, :2], skip=0)
        particle_filter(case.structure, few, particles=2)(first, late.fit.noise)
        near = first.with_log(first.to_log() + NEAR * np.resize([1.0, -1.0, -1.0, 1.0], len(case.truth)))
        row("particle filter, near", *timed(lambda s: particles(case, s), [near]))
        draws = [
            particle_filter(case.structure, runs, particles=PARTICLES, seed=seed)(
                late.parameters, late.fit.noise
            ).log_likelihood
            for seed in range(5)
        ]
        print(
            f"  at the EKF estimate: log-likelihood of {PARTICLES} particles {np.mean(draws) - late.fit.log_likelihood:.0f} to that of the EKF,"
            f" +-{np.std(draws, ddof=1):.0f} over seeds; one standard deviation of a parameter is worth 0.5"
        )
    print(flush=True)


def equivalence(case: Case) -> None:
    """Print how far local PEM and FRF matching are from each other in standard deviations, and these over each
    other."""
    names, start = parameter_names(case.robot), Parameters.nominal(case.robot).with_log(case.truth)
    frf = estimate_frf(case.data)
    match = fit_frf(
        case.structure,
        frf,
        start,
        sample_time=case.runs.sample_time,
        hold="zoh",
        estimator="wnls",
        starts=(start,),
        fitted=names,
    )
    local = fit_prediction(local_predictor(case.structure, case.runs), case.structure, start, first_noise(case))
    std = np.sqrt(np.diag(local.covariance))[: len(names)]
    apart = (local.parameters.to_log() - match.parameters.to_log()) / std
    ratio = np.sqrt(np.diag(match.covariance)) / std
    share = np.mean(case.robot.array("tau_std") ** 2 / case.runs.u[:, case.runs.skip :].var(axis=(0, 1)))
    print(
        f"{case.title}: local PEM less WNLS on FRFs {np.sqrt(np.mean(apart**2)):.2f} standard deviations (rms), deviations of WNLS over PEM"
        f" {np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f}); noise of the recorded torque {share:.1e} of its power"
    )


def whole_arm() -> None:
    """Print what the FRF fit of the whole irb takes, and one Jacobian of its rivals over data of the same length."""
    case, seconds = frf_case(15, 80), []
    for k in range(3):
        _, error, took = fitted_case(case, draw(case, np.random.default_rng(k)), "wlls", case["nominal"])
        seconds.append(took)
    fit = float(np.median(seconds))
    print(
        f"irb, WLLS on given FRFs of 15 points x 80 lines x 6 x 6: {fit:.2f} CPU s from one start (median of 3), worst error {np.abs(error).max():.1e}"
    )
    arm = make_case("irb", load_robot("irb"), 1, level=1.0, period=500)
    samples = 15 * 6 * 20000  # one period a FRF of frf_case
    predict, start = extended_kalman(arm.structure, arm.runs), arm.starts[0]
    predict(start, first_noise(arm))
    began = time.process_time()
    predict(start, first_noise(arm))
    filtered = (time.process_time() - began) / (arm.runs.u.shape[0] * arm.runs.u.shape[1])
    model = build_plant(load_robot("irb"), timestep=STEP).model
    data, steps = mujoco.MjData(model), 2000
    began = time.process_time()
    mujoco.mj_step(model, data, nstep=steps)
    rolled = (time.process_time() - began) / steps
    for name, each in (("extended Kalman filter", filtered), ("MuJoCo step of 1 ms, RK4", rolled)):
        once = each * samples
        print(
            f"  {name}: {1e6 * each:.0f} us a sample, so {once:.0f} s for one look at one period of each of those 90 experiments, and"
            f" {once * (len(case['fitted']) + 1):.0f} s ({once * (len(case['fitted']) + 1) / fit:.0f} x WLLS) for one Jacobian: extrapolated"
        )
    print(flush=True)


def main(full: bool, arms: Collection[str]) -> None:
    starts = 10 if full else 2
    print(f"commit {commit()}")
    cases = []
    if "twomass" in arms:
        cases.append((make_case("twomass", load_robot("twomass"), starts, level=3.0, high=200.0), {}))
    if "pair" in arms:
        cases.append((make_case("two joints of the ur10", pair(), starts, level=1.0), {"chance": True}))
        equivalence(make_case("two joints of the ur10, a tenth of the excitation", pair(), 1, level=0.1))
    for case, _ in cases:
        equivalence(case)
    print()
    if "ur10" in arms:
        # Minutes a fit: one operating point and one start.
        cases.append((make_case("ur10", load_robot("ur10"), 1, level=1.0), {"filtered": full, "simulated": full}))
    for case, options in cases:
        table(case, **options)
    if "irb" in arms:
        whole_arm()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="ten starts, and all methods on the whole ur10")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS, help="those to look at")
    options = parser.parse_args()
    main(options.full, options.arms)
