"""The true plant: a MuJoCo arm in closed loop, with hidden effects. Knows nothing of ``ident``'s models."""

from sim.effects import EFFECTS, draw_effect, parse_effect
from sim.experiment import run_experiment

__all__ = ["EFFECTS", "draw_effect", "parse_effect", "run_experiment"]
