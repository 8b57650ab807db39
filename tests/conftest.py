"""Shared experiments: small, made once per worker."""

from __future__ import annotations

import os

import numpy as np
import pytest
import tomlkit
from hypothesis import settings
from threadpoolctl import threadpool_limits

from ident.dataset import Dataset
from ident.dataset_io import load_dataset, save_dataset
from ident.excitation import operating_points
from ident.identification import identify
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.experiment import draw_drives, plan_experiment

settings.register_profile("repeatable", derandomize=True)  # the default suite says the same of the same code
settings.register_profile("random")
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

threadpool_limits(1)  # workers share the cores: threads of each would only wait for each other, ten times as long


def small_plan(
    robot, seed, *, points=2, levels=(1.0, 0.4), period=2000, validation_points=1, trajectory=False, **kwargs
):
    """A plan of 2 s periods, scaled to the arm."""
    postures = operating_points(robot, points + validation_points, np.random.default_rng(seed))
    return plan_experiment(
        robot,
        postures,
        points=points,
        validation_points=validation_points,
        levels=levels,
        seed=seed,
        period=period,
        trajectory=trajectory,
        **kwargs,
    )


def quick_experiment(plan, effects=(), **kwargs):
    """``run_experiment`` in half as many steps: for an arm alone the error is still within a hundredth of its noise."""
    return run_experiment(plan, effects, **{"timestep": 5e-4, **kwargs})


def through_postures(rng, n, rate, seconds):
    """Times, and positions, velocities and accelerations of a motion through many postures, of five lines from 0.1 Hz
    on."""
    t = np.arange(int(seconds * rate)) / rate
    w = 2 * np.pi * 0.1 * np.arange(1, 6)
    a, b = rng.normal(size=(2, 5, n)) * 0.25
    arg = np.multiply.outer(t, w)
    q = np.sin(arg) @ a + np.cos(arg) @ b + rng.uniform(-0.5, 0.5, n)
    v = (np.cos(arg) * w) @ a - (np.sin(arg) * w) @ b
    return t, q, v, -(np.sin(arg) * w**2) @ a - (np.cos(arg) * w**2) @ b


def of_motions(robot, rate, segments, **given):
    """A dataset of motions of a robot alone, sampled at ``rate`` Hz; noise as given, else as its records show it."""
    noise = {"q_std": None, "tau_std": None} | {key: np.full(robot.n, std) for key, std in given.items()}
    return Dataset(
        name="motions",
        robot=robot,
        sample_rate=rate,
        joints=robot.joint_names,
        input_hold="none",
        controller=None,
        segments=tuple(segments),
        **noise,
    )


def over_steps(torque, x, parts=1000):
    """Mean of a torque of the deflection over steps of time, in each of which ``x`` (S, T) goes along a line."""
    spread = 0.5 * np.abs(np.roll(x, -1, axis=1) - np.roll(x, 1, axis=1))
    return sum(torque(x + u * spread) for u in (np.arange(parts) + 0.5) / parts - 0.5) / parts


def through_files(data, folder):
    """What a user's diagnosis sees: the files alone."""
    save_dataset(data, folder / "dataset")
    return load_dataset(folder / "dataset")


@pytest.fixture(scope="session")
def ur10():
    return load_robot("ur10")


@pytest.fixture(scope="session")
def locked(ur10, tmp_path_factory):
    """The same arm with its wrist locked: three joints."""
    folder = tmp_path_factory.mktemp("locked")
    robot = tomlkit.parse((ur10.folder / "robot.toml").read_text(encoding="utf-8"))
    robot["locked"] = {joint["name"]: 0.3 for joint in robot["joint"][3:]}
    robot["joint"] = robot["joint"][:3]
    (folder / "robot.toml").write_text(tomlkit.dumps(robot), encoding="utf-8")
    return load_robot(folder)


@pytest.fixture(scope="session")
def clean(ur10, tmp_path_factory):
    """(dataset read from files, true drives): nothing hidden, drives off by up to two."""
    drives = draw_drives(np.random.default_rng(5), ur10)
    data = quick_experiment(small_plan(ur10, 5, trajectory=True), seed=5, drives=drives)
    return through_files(data, tmp_path_factory.mktemp("clean")), drives


@pytest.fixture(scope="session")
def identified(clean):
    """(dataset, what was set up, baseline) of the clean experiment."""
    return clean[0], *identify(clean[0])
