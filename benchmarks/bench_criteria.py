"""NLS, WNLS, LLS and WLLS on the irb: which finds home from far off, and which bears model error best.

- Convergence: each criterion alone from starts off the truth by up to a factor, every spring and damper at once, and
  WLLS after a search by LLS, as ``fit_frf`` does it. Noise only.
- Model error: Coulomb friction at every motor that the model lacks, of a share of the rms excitation torque. Errors of
  parameters, and of the FRFs predicted at held-out postures against those measured there and those of the arm without
  friction.

Wernholt and Moberg (2011) find WLLS best on their robot.

    python benchmarks/bench_criteria.py [--full]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from bench_estimators import draw, frf_case

from ident.candidates import draw_candidates
from ident.chain import Structure, build_structure
from ident.estimate import ESTIMATORS, fit_frf
from ident.frf import estimate_frf
from ident.frf_basis import FRF
from ident.graybox import Parameters, equilibrium, linearise, parameter_names, sampled_frf
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.effects.friction import CoulombFriction
from sim.experiment import plan_experiment

FACTORS = (1.5, 2.0, 3.0)
HOME = 0.1  # largest log-error of a spring that counts as found, beyond that of the best end
POINTS, HELD_OUT = 4, 2
SHARES = (0.0, 0.03, 0.1, 0.3)  # Coulomb friction over the rms excitation torque of its joint
OFF = np.log(1.4)  # of the true parameters from the data sheet, at most
CLEAR = 10.0  # ratio of an entry to its deviation from which it is compared with what was measured
PARTS = {
    "springs": slice(0, 6),
    "across": slice(24, 30),
    "dampers": slice(6, 12),
    "across ": slice(30, 36),
    "inertia": slice(12, 18),
}


def convergence_table(count: int, lines: int = 24) -> None:
    """Print the share of starts from which each criterion finds all springs."""
    case = frf_case(POINTS, lines)
    rng = np.random.default_rng(1)
    frf, truth, free = draw(case, rng), case["truth"], case["chosen"]
    spring = np.array([name.startswith("stiffness") for name in parameter_names(case["structure"].robot)])
    rows = [(e.upper(), e, False) for e in ESTIMATORS] + [("LLS, then WLLS", "wlls", True)]
    print(
        f"irb, {POINTS} points x {lines} lines, 3 % noise, {count} starts: share that ends with every spring within {HOME:.0%} of the best end"
    )
    print("starts within    " + "".join(f"{name:>16s}" for name, _, _ in rows))
    for factor in FACTORS:
        starts = [
            truth.with_log(truth.to_log() + free * np.log(factor) * rng.uniform(-1, 1, len(free))) for _ in range(count)
        ]
        cells = []
        for _, estimator, search in rows:
            options = {"sample_time": 1e-3, "hold": "zoh", "estimator": estimator, "fitted": case["fitted"]}
            home = fit_frf(case["structure"], frf, truth, starts=[truth], search=False, **options).parameters.to_log()
            ends = [
                fit_frf(case["structure"], frf, s, starts=[s], search=search, **options).parameters.to_log()
                for s in starts
            ]
            cells.append(np.mean([np.abs(end - home)[spring].max() < HOME for end in ends]))
        print(f"x or / {factor:<9g} " + "".join(f"{c:16.2f}" for c in cells), flush=True)
    print()


def modelled(structure: Structure, par: Parameters, frf: FRF) -> np.ndarray:
    """FRFs of a model at the postures and lines of measured ones, (Q, F, n, n)."""
    lins = [linearise(structure, equilibrium(structure, par, q)) for q in frf.q0]
    return np.stack([sampled_frf(structure, par, lin, frf.frequency, 1e-3, "zoh")[0] for lin in lins])


def model_error_case(share: float, seed: int) -> dict[str, tuple[np.ndarray, float, float, float]]:
    """Per criterion: errors of the log-parameters, misfit of the intervals, errors at held-out postures."""
    robot, rng = load_robot("irb"), np.random.default_rng(seed)
    structure, nominal = build_structure(robot), Parameters.nominal(robot)
    true = nominal.with_log(nominal.to_log() + OFF * rng.uniform(-1, 1, len(nominal.to_log())))
    hinges = zip(robot.elasticities, true.elastic_stiffness, true.elastic_damping, strict=True)
    arm = replace(robot, elasticities=tuple(replace(e, stiffness=float(k), damping=float(d)) for e, k, d in hinges))
    postures = draw_candidates(robot, POINTS + HELD_OUT, rng).q
    plan = plan_experiment(
        robot,
        postures,
        points=POINTS,
        validation_points=HELD_OUT,
        realizations=2,
        levels=(1.0,),
        seed=seed,
        period=3000,
        band_hz=(0.8, 60.0),
        per_decade=60,
        trajectory=False,
    )
    size = np.stack([e.r for e in plan.experiments]).reshape(-1, robot.n).std(axis=0)
    hidden = (
        [CoulombFriction(j, float(share * s)) for j, s in zip(robot.joint_names, size, strict=True)] if share else []
    )
    drives = {
        "stiffness": true.stiffness,
        "damping": true.damping,
        "motor_inertia": true.inertia,
        "viscous_friction": true.viscous,
    }
    data = run_experiment(replace(plan, robot=arm), hidden, drives=drives, seed=seed, timestep=1e-3)
    frf, held = estimate_frf(data), estimate_frf(data, role="validation")
    clear = np.abs(held.G) > CLEAR * held.total_std
    exact = modelled(structure, true, held)
    out = {}
    for estimator in ESTIMATORS:
        fit = fit_frf(structure, frf, nominal, starts=[nominal], sample_time=1e-3, hold="zoh", estimator=estimator)
        model = modelled(structure, fit.parameters, held)
        error = fit.parameters.to_log() - true.to_log()
        inside = np.mean(np.abs(error) < 1.96 * np.sqrt(np.diag(fit.covariance))[:-1])
        measured = np.median(np.abs(np.log(model / held.G))[clear])
        out[estimator] = error, float(inside), float(measured), float(np.median(np.abs(np.log(model / exact))))
    return out


def model_error_table(shares: tuple[float, ...], seeds: range) -> None:
    """Print errors of parameters and of predicted FRFs over the share of friction."""
    print(
        f"irb, {POINTS} postures, parameters off by up to 40 %, Coulomb friction hidden at every joint, {len(seeds)} seed(s)"
    )
    print("errors in %: parameters rms, FRFs at held-out postures median of |log ratio|")
    print(
        "friction  estimator "
        + "".join(f"{k.strip():>9s}" for k in PARTS)
        + "   inside 95 %   held out: measured   frictionless"
    )
    for share in shares:
        cases = [model_error_case(share, seed) for seed in seeds]
        for estimator in ESTIMATORS:
            errors, inside, measured, exact = (np.array([c[estimator][k] for c in cases]) for k in range(4))
            cells = [100 * np.sqrt(np.median(np.mean(errors[:, part] ** 2, axis=1))) for part in PARTS.values()]
            print(
                f"{share:8.2f}  {estimator.upper():9s} "
                + "".join(f"{c:9.3f}" for c in cells)
                + f"{inside.mean():14.2f}{100 * np.median(measured):21.2f}{100 * np.median(exact):15.2f}",
                flush=True,
            )
    print()


def main(full: bool = False) -> None:
    convergence_table(24 if full else 8)
    model_error_table(SHARES if full else (0.0, 0.1), range(1, 6 if full else 2))


if __name__ == "__main__":
    main("--full" in sys.argv[1:])
