"""Laws of drives and encoders that are a little more than the catalogue says: two poles, an oval disc."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.chain import build_structure
from ident.contests import best_of_each, forms_to_try, narrower
from ident.diagnosis import diagnose
from ident.evidence import Candidate
from ident.hypotheses import catalogue, wider_forms
from ident.hypotheses.filters import lag, second_order_lag
from ident.model import Effect
from tests.conftest import quick_experiment, small_plan, through_files

S = 1j * np.linspace(0.0, 2e3, 50)
JOINT, PLACE, LATE = 2, "elbow_joint", 3e-3


def test_one_of_second_order_holds_one_of_first_and_two_in_a_row():
    assert np.allclose(second_order_lag([1e-3, 0.0], S), lag([1e-3], S))
    assert np.allclose(second_order_lag([2e-3, 0.25], S), lag([1e-3], S) ** 2)
    slow = S[:5]
    assert np.allclose(second_order_lag([1e-3, 0.5], slow), np.exp(1e-3 * slow), atol=2e-3)


def test_wider_forms_are_asked_for_where_the_plain_ones_stand(locked):
    laws = list({h.key: h for h in catalogue(build_structure(locked)) if not h.options.get("yields")}.values())
    asked = {h.effect: [x.effect for x in wider_forms(h)] for h in laws}
    assert {k: v for k, v in asked.items() if v} == {
        "torque_delay": ["torque_lag"],
        "torque_lag": ["torque_lag"],
        "sensor_delay": ["sensor_lag"],
        "sensor_lag": ["sensor_lag"],
        "encoder_eccentricity": ["encoder_eccentricity"],
        "presliding_friction": ["presliding_friction"],
        "gravity_spring": ["gravity_spring", "dress_pack"],
        "dress_pack": ["dress_pack"],
    }
    (wide,) = wider_forms(next(h for h in laws if h.effect == "torque_delay"))
    assert wider_forms(wide) == []


def test_a_law_and_its_wider_form_are_weighed_against_each_other(locked):
    """What is a little nearer to the data with more parameters need not win."""
    plain = next(h for h in catalogue(build_structure(locked)) if h.effect == "torque_lag")
    (wide,) = wider_forms(plain)
    ran = [Candidate(h, SimpleNamespace(cost=cost), 0.0) for h, cost in ((plain, 100.0), (wide, 99.9), (plain, 120.0))]
    assert {(id(c.hypothesis), c.fit.cost) for c in best_of_each(ran)} == {(id(plain), 100.0), (id(wide), 99.9)}


def test_every_wider_form_knows_the_way_back(locked):
    """Beside a cause that was missing it may have stood for that."""
    problem = SimpleNamespace(structure=build_structure(locked), motions_alone=False)
    forms = [x for h in catalogue(problem.structure) for x in wider_forms(h)]
    assert {x.effect for x in forms} >= {"gravity_spring", "dress_pack", "presliding_friction", "sensor_lag"}
    for form in forms:
        sizes = np.array(
            [q.to_external(0.3 * (q.to_internal(q.lower) + q.to_internal(q.upper))) for q in form.parameters]
        )
        (plain,) = narrower(problem, Effect(form, sizes))
        assert plain.hypothesis.key == form.key and "holds" not in plain.hypothesis.options
        assert len(plain.p) == len(plain.hypothesis.parameters)
        assert narrower(problem, plain) == []


def filtered(segment, channel, change):
    """A multisine with another signal at the joint: each period times ``change`` of complex frequencies, rad/s."""
    x = getattr(segment, channel).copy()
    N = segment.period
    s = 2j * np.pi * np.fft.rfftfreq(N, segment.t[1] - segment.t[0])
    for k in range(0, len(x) - N + 1, N):
        x[k : k + N, JOINT] = np.fft.irfft(change(s) * np.fft.rfft(x[k : k + N, JOINT]), N)
    return replace(segment, **{channel: x})


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "channel", "square"), [("torque_lag", "tau", 0.4), ("sensor_lag", "q", 0.25)])
def test_a_lag_of_second_order_is_one_cause(locked, tmp_path, effect, channel, square):
    """Not a delay with a lag beside it."""
    data = quick_experiment(small_plan(locked, 3), seed=3)

    def change(s):
        way = second_order_lag([LATE, square], s)
        return way if channel == "tau" else 1.0 / way

    data = replace(data, segments=tuple(filtered(x, channel, change) for x in data.segments))
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [(effect, PLACE)]
    found = verdict.causes[0].parameters
    assert found["time_constant"].value == pytest.approx(LATE, rel=0.01)
    assert found["square"].value == pytest.approx(square, abs=0.03)


@pytest.mark.slow
def test_an_encoder_out_of_centre_that_is_oval_too_is_one_cause(locked, tmp_path):
    """Not a gear that errs beside it."""
    data = quick_experiment(small_plan(locked, 3, points=4), seed=3)

    def with_error(segment):
        q = segment.q.copy()
        q[:, JOINT] += 0.02 * np.sin(q[:, JOINT] + 1.0) + 0.004 * np.sin(2.0 * q[:, JOINT])
        return replace(segment, q=q)

    data = replace(data, segments=tuple(map(with_error, data.segments)))
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("encoder_eccentricity", PLACE)]
    found = verdict.causes[0].parameters
    assert found["amplitude"].value == pytest.approx(0.02, rel=0.05)
    assert verdict.unexplained_verdict == "noise floor reached"


@pytest.mark.parametrize(("motions", "yields"), [(True, False), (True, True), (False, True)])
def test_a_bundle_at_rest_elsewhere_is_asked_for_in_motions_too(locked, monkeypatch, motions, yields):
    """It is a static law of the link; laws of drives and encoders show above the modes of the links only."""
    monkeypatch.setattr("ident.contests.unsettled_at", lambda fit, joint: True)
    problem = SimpleNamespace(structure=build_structure(locked), motions_alone=motions)
    laws = catalogue(problem.structure, motions_alone=motions)
    bundle = next(h for h in laws if h.effect == "dress_pack" and h.options["yields"] == yields)
    (hung,) = forms_to_try(problem, None, bundle)
    own = [q.name for q in bundle.parameters]
    assert [q.name for q in hung.parameters] == [*own, "rest_angle"]
    p = np.array([2.0, 0.5, 0.01, 0.0])[: len(own)]
    assert hung.options["widens"](p, None)[0].tolist() == [*p, 0.0]
    assert hung.options["narrow"](np.array([*p, 0.3])).tolist() == p.tolist()
    lag = next(h for h in laws if h.effect == "torque_lag")
    spring = next(h for h in laws if h.effect == "gravity_spring" and "holds" not in h.options)
    for other in (lag, spring):
        assert bool(forms_to_try(problem, None, other)) != motions
