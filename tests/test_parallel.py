"""Where work runs changes nothing of what comes out."""

import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from inspect import signature
from multiprocessing import get_context
from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from ident.dataset import Dataset
from ident.design import design_experiment
from ident.diagnosis import diagnose, diagnose_fully, unsought
from ident.estimate import fit_frf
from ident.hypotheses import catalogue
from ident.identification import identify
from ident.notes import NOT_SOUGHT, TIME_UP
from ident.parallel import GRACE, TimeIsUp, Workers, map_threads, open_executor
from ident.problem import NOT_COMPUTED, predictions
from ident.screening import screen
from ident.strong import beside_strong
from ident.torque_fit import fit
from robot_assets.errors import DataError
from robot_assets.robot import load_robot
from robot_assets.threads import thread_count
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("parallel")  # one worker makes what they share


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """A small case with several candidates, and its verdict made on the threads of this process."""
    robot = load_robot("twomass")
    hidden = parse_effect("coulomb_friction@drive:torque=0.1", robot)
    data = quick_experiment(small_plan(robot, 4, period=1000, levels=(10.0, 4.0)), [hidden], seed=4)
    data = through_files(data, tmp_path_factory.mktemp("two"))
    return data, verdict_of(data)


def verdict_of(data, **kwargs):
    return json.dumps(diagnose(data, **{"max_causes": 1} | kwargs).to_dict())


def test_the_case_is_worth_the_comparison(friction):
    causes = json.loads(friction[1])["causes"]
    assert [c["effect"] for c in causes] == ["coulomb_friction"] and causes[0]["probability"] > 0.9


def test_processes_give_the_same_verdict_bit_for_bit(friction):
    lines = []
    with open_executor("processes:2") as executor:
        assert verdict_of(friction[0], executor=executor, progress=lines.append) == friction[1]
    assert any(line.startswith("refit: coulomb_friction") for line in lines)


def test_a_dask_cluster_gives_the_same_verdict_bit_for_bit(friction):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with open_executor(cluster.scheduler_address.replace("tcp", "dask")) as executor:
            assert verdict_of(friction[0], executor=executor) == friction[1]


def test_a_search_without_time_says_so_and_names_nothing(friction):
    verdict = diagnose(friction[0], max_seconds=0.0)
    assert verdict.discrepancy.detected and not verdict.causes
    assert verdict.unexplained_verdict == "unknown cause remains"
    assert "0 s for the search" in verdict.notes[-1] and "more may be found" in verdict.notes[-1]
    assert verdict.sentence == "The simulation misses something, and no cause was searched for."
    assert json.loads(friction[1])["notes"] == []


def test_where_no_causes_are_asked_for_nothing_is_said_of_what_the_catalogue_explains(friction):
    verdict = diagnose(friction[0], max_causes=0)
    assert verdict.discrepancy.detected and not verdict.causes and verdict.next_experiment is None
    assert verdict.unexplained_verdict == "unknown cause remains"
    assert verdict.sentence == "The simulation misses something, and no cause was searched for."


def test_a_search_that_ended_before_it_found_anything_says_nothing_of_the_catalogue_either():
    sought = SimpleNamespace(result=SimpleNamespace(rounds=()), late=True)
    assert unsought(sought, begins=True) == TIME_UP and unsought(sought, begins=False) == NOT_SOUGHT
    sought.late = False
    assert unsought(sought, begins=True) == ""
    sought.result.rounds = ("one",)
    assert unsought(sought, begins=False) == ""


def test_drives_that_were_fitted_from_guesses_are_told(friction):
    data = friction[0]
    robot = replace(data.robot, guessed=data.robot.guessed | {"motor_inertia": ("drive",)})
    (note,) = (x for x in diagnose(replace(data, robot=robot), max_seconds=0.0).notes if "guesses" in x)
    assert "drives of drive " in note


@pytest.mark.parametrize("text", ["", "cores", "processes:0", "processes:two", "dask://", "dask:host", "threads:2"])
def test_an_executor_that_is_none_is_refused(text):
    with pytest.raises(DataError, match="--executor"):
        with open_executor(text):
            pass


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("ident.parallel.ANSWER", 1.0)
    with pytest.raises(DataError, match=r"127\.0\.0\.1:9"):
        with open_executor("dask://127.0.0.1:9"):
            pass


@pytest.mark.parametrize("given", ["two", "0", "-1", "1.5"])
def test_a_number_of_threads_that_is_none_is_refused(monkeypatch, given):
    monkeypatch.setenv("SIMGAP_THREADS", given)
    with pytest.raises(DataError, match="SIMGAP_THREADS"):
        map_threads(str, [1, 2])


def test_threads_are_those_asked_for(monkeypatch):
    monkeypatch.setenv("SIMGAP_THREADS", "3")
    assert thread_count() == 3
    assert map_threads(lambda x: x * x, range(5)) == [0, 1, 4, 9, 16]


def test_a_clear_error_stays_one_on_its_way_from_another_process():
    def fails(x):
        raise DataError("a", "b", "c", "d")

    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        with pytest.raises(DataError, match="a: b: found c, expected d"):
            Workers(pool).map(fails, [1])


def test_functions_made_on_the_spot_reach_other_processes():
    factor = 3
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert Workers(pool).map(lambda x: factor * x, [1, 2], str) == [3, 6]


def test_pieces_that_the_deadline_comes_before_are_left_out():
    assert Workers(deadline=0.0).map_in_time(lambda x: 2 * x, [1, 2], str) == [None, None]
    assert Workers().map_in_time(lambda x: 2 * x, [1, 2], str) == [2, 4]


@pytest.mark.parametrize("function", [diagnose_fully, identify, screen, fit, fit_frf, design_experiment])
def test_linear_algebra_starts_no_threads_within_what_users_call(function):
    """Threads for each of many small matrices wait for each other, up to twenty times as long."""
    seen = []

    class Asked(Exception):
        pass

    class Probe:
        __class__ = Dataset  # what is none is refused before anything is computed

        def __getattr__(self, name):
            seen.extend(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")
            raise Asked

    needed = [
        p for p in signature(function).parameters.values() if p.default is p.empty and p.kind is not p.VAR_KEYWORD
    ]
    with threadpool_limits(2), pytest.raises(Asked):
        function(**{p.name: Probe() for p in needed})
    assert seen and set(seen) == {1}


def test_work_that_has_begun_is_given_up_some_time_after_the_deadline():
    """As one whose model has no solution; never where an executor began all of it together."""
    now = time.monotonic()
    with pytest.raises(TimeIsUp):
        Workers(deadline=now - GRACE - 1.0).until_late("a step")
    assert issubclass(TimeIsUp, NOT_COMPUTED)
    Workers(deadline=now - 1.0).until_late("a step")
    Workers().until_late("a step")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        Workers(executor=pool, deadline=now - GRACE - 1.0).until_late("a step")


def test_a_strong_effect_that_takes_too_long_is_no_candidate(friction, monkeypatch):
    data, _ = friction
    setup, first = identify(data)
    scores = screen(
        setup.problem,
        first,
        predictions(setup.problem, first.model, first.remainders),
        [h for h in catalogue(setup.problem.structure) if h.effect == "coulomb_friction"],
    )
    told: list[str] = []
    in_time = Workers(progress=told.append)
    found = beside_strong(setup.problem, first, [], scores, in_time)[1]
    assert found and told
    monkeypatch.setattr(Workers, "late", False)  # each is begun
    late = Workers(progress=told.append, deadline=time.monotonic() - GRACE - 1.0)
    assert beside_strong(setup.problem, first, [], scores, late)[1] == []
