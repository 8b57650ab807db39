"""The experiment of Wernholt and Moberg (2011) on the irb at its full size: twelve spring-dampers, fifteen optimal
points.

Fifteen D-optimal postures and three random ones, held out; torque noise of 1 to 2 % of the peak of the excitation;
parameters off the data sheet by up to 40 %, from which the fit starts. Then, at the level of FRFs, draws of the noise
with the covariance that was measured: coverage of 95 % intervals.

    python benchmarks/bench_paper.py [--full | DRAWS]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from ident.chain import Structure, build_structure
from ident.design import design_experiment, design_plan
from ident.estimate import fit_frf
from ident.frf import estimate_frf
from ident.frf_basis import FRF
from ident.graybox import Parameters, equilibrium, linearise, sampled_frf
from robot_assets.robot import load_robot
from sim import run_experiment

POINTS, HELD_OUT = 15, 3
OFF = np.log(1.4)
NOISE = 1.6  # times that of robot.toml
PARTS = {
    "springs of gears": slice(0, 6),
    "springs across": slice(24, 30),
    "dampers of gears": slice(6, 12),
    "dampers across": slice(30, 36),
    "motor inertia": slice(12, 18),
    "viscous friction": slice(18, 24),
}
WANTED = {"springs of gears": 0.005, "springs across": 0.02, "dampers of gears": 0.2, "dampers across": 0.2}
COVERAGE = (0.90, 0.99)


def modelled(structure: Structure, par: Parameters, frf: FRF) -> np.ndarray:
    """FRFs of a model at the postures and lines of measured ones, (Q, F, n, n)."""
    lins = [linearise(structure, equilibrium(structure, par, q)) for q in frf.q0]
    return np.stack([sampled_frf(structure, par, lin, frf.frequency, 1e-3, "zoh")[0] for lin in lins])


def redrawn(frf: FRF, exact: np.ndarray, rng: np.random.Generator) -> FRF:
    """FRFs of the true arm with noise of the measured covariance."""
    Q, F, n, _ = frf.G.shape
    scale = np.sqrt(np.einsum("qfii->qfi", frf.covariance).real)
    correlation = frf.covariance / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(n * n)
    white = (rng.standard_normal((Q, F, n * n, 1)) + 1j * rng.standard_normal((Q, F, n * n, 1))) / np.sqrt(2)
    e = scale * (np.linalg.cholesky(correlation) @ white)[..., 0]
    return replace(frf, G=exact + np.swapaxes(e.reshape(Q, F, n, n), -1, -2))


def main(draws: int = 10) -> None:
    robot, rng = load_robot("irb"), np.random.default_rng(1)
    structure, nominal = build_structure(robot), Parameters.nominal(robot)
    true = nominal.with_log(nominal.to_log() + OFF * rng.uniform(-1, 1, len(nominal.to_log())))
    hinges = zip(robot.elasticities, true.elastic_stiffness, true.elastic_damping, strict=True)
    arm = replace(robot, elasticities=tuple(replace(e, stiffness=float(k), damping=float(d)) for e, k, d in hinges))
    drives = {
        "stiffness": true.stiffness,
        "damping": true.damping,
        "motor_inertia": true.inertia,
        "viscous_friction": true.viscous,
    }

    began = time.process_time()
    design = design_experiment(
        robot, points=POINTS, candidates=4000, seed=1, period=4000, periods=3, band_hz=(0.8, 60.0), per_decade=60
    )
    plan = replace(design_plan(design, validation_points=HELD_OUT), trajectories=())
    print(
        f"irb, {POINTS} of 4000 postures, gap {design.weights.gap:.0e}, {len(plan.excitation.lines)} lines; design {time.process_time() - began:.0f} CPU s"
    )
    peak = np.abs(np.stack([e.r for e in plan.experiments])).max(axis=(0, 1))
    print(
        "torque noise, % of the peak of the excitation: "
        + " ".join(f"{100 * v:.1f}" for v in NOISE * robot.array("tau_std") / peak)
    )
    began = time.process_time()
    data = run_experiment(replace(plan, robot=arm), drives=drives, seed=1, noise=NOISE, timestep=1e-3)
    print(
        f"{len(data.segments)} experiments, {sum(s.n_samples for s in data.segments) / 1000:.0f} s of recording, {time.process_time() - began:.0f} CPU s"
    )
    frf, held = estimate_frf(data), estimate_frf(data, role="validation")
    began = time.process_time()
    fit = fit_frf(structure, frf, nominal, starts=[nominal], sample_time=1e-3, hold="zoh")
    took = time.process_time() - began
    error = fit.parameters.to_log() - true.to_log()
    std = np.sqrt(np.diag(fit.covariance))[:-1]
    print(f"WLLS from the data sheet, {took:.1f} CPU s; cost per residual {fit.cost / fit.residuals:.2f}")
    print(f"{'':18s} largest error   largest std   wanted")
    for name, part in PARTS.items():
        wanted = WANTED.get(name)
        verdict = "" if wanted is None else f"{wanted:8.1%} {'met' if np.abs(error[part]).max() < wanted else 'MISSED'}"
        print(f"{name:18s}{np.abs(np.expm1(error[part])).max():14.3%}{std[part].max():14.3%} {verdict}")
    for title, par in (("data sheet", nominal), ("identified", fit.parameters)):
        model = modelled(structure, par, held)
        z = np.sqrt(np.mean((np.abs(held.G - model) / held.total_std) ** 2))
        clear = np.abs(held.G) > 10 * held.total_std
        log = np.median(np.abs(np.log(model / held.G))[clear])
        print(
            f"{HELD_OUT} held-out postures, {title}: residual over standard deviation, rms {z:.2f}; |log ratio|, median {log:.2%}"
        )

    exact, inside, errors = modelled(structure, true, frf), [], []
    for _ in range(draws):
        again = fit_frf(structure, redrawn(frf, exact, rng), nominal, starts=[nominal], sample_time=1e-3, hold="zoh")
        errors.append(again.parameters.to_log() - true.to_log())
        inside.append(np.abs(errors[-1]) < 1.96 * np.sqrt(np.diag(again.covariance))[:-1])
    share = np.mean(inside, axis=0)
    print(
        f"{draws} draws: 95 % intervals cover {share.mean():.3f} (wanted {COVERAGE[0]:g} to {COVERAGE[1]:g}), least of a parameter {share.min():.2f}"
    )
    for name, part in PARTS.items():
        e = np.array(errors)[:, part]
        print(
            f"{name:18s} covered {share[part].mean():.3f}, worst error of all draws {np.abs(e).max():.3%}, bias over std {np.abs(e.mean(axis=0) / e.std(axis=0)).max():.2f}"
        )


if __name__ == "__main__":
    main(100 if "--full" in sys.argv[1:] else int(sys.argv[1]) if len(sys.argv) > 1 else 10)
