"""Figures of the report, as SVG text."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from ident.verdict import EvidencePlot, FrfView, SpectrumMap, TorqueTrace, Verdict

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

# Stand-ins that the page replaces by its own colours, light or dark.
INK, SOFT, GRID, MEASURED, BEFORE, AFTER = "#0a0b0c", "#0a0b0d", "#0a0b0e", "#0a0b0f", "#0a0b10", "#0a0b11"
CSS = {
    INK: "var(--ink)",
    SOFT: "var(--soft)",
    GRID: "var(--line)",
    MEASURED: "var(--measured)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
}
PLAIN = {INK: "#1d2227", SOFT: "#5c6670", GRID: "#dfe2e4", MEASURED: "#4a525a", BEFORE: "#c8553d", AFTER: "#1f7a9c"}
DARK = {INK: "#e6e8ea", SOFT: "#9aa4ad", GRID: "#34393e", MEASURED: "#b9c1c8", BEFORE: "#e0694e", AFTER: "#3f9fc4"}
STYLE: dict[RcKeyType, Any] = {
    "font.size": 8,
    "text.color": INK,
    "axes.labelcolor": SOFT,
    "axes.edgecolor": SOFT,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.6,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "axes.facecolor": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "simgap",  # the same data are the same picture
}
SHOWN_JOINTS = 3
POINTS = 1500
CURVE = 300
FREQUENCIES = 1.0, 2.0, 5.0  # that are told of each decade
MOST_DIGITS = 6  # of a number, however small its standard deviation
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def rounded(value: float, std: float) -> str:
    """A number and its standard deviation, both to two digits of the latter; the number to no more than
    ``MOST_DIGITS``."""
    if not (np.isfinite(std) and std > 0 and np.isfinite(value)):
        return f"{value + 0.0:.5g}" if std == 0 else f"{value + 0.0:.5g} ± {std:.2g}"
    size = max(abs(value), std)
    power, last = (int(np.floor(np.log10(x))) for x in (size, std))
    if power - last + 2 > MOST_DIGITS:
        return f"{_by_power(value, MOST_DIGITS)} ± {_by_power(std, 2)}"
    if not 1e-3 <= size < 1e6:
        decimals = max(0, power - last + 1)
        return f"({_fixed(value / 10.0**power, decimals)} ± {std / 10.0**power:.{decimals}f}){_power(power)}"
    decimals = max(0, 1 - last)
    return f"{_fixed(value, decimals)} ± {std:.{decimals}f}"


def _fixed(value: float, decimals: int) -> str:
    """A number with so many decimals; no zero has a sign."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def _by_power(value: float, digits: int) -> str:
    """A number with so many digits, by its power of ten where it is very small or large."""
    if value == 0.0:
        return "0"
    shown = float(f"{value:.{digits}g}")
    power = int(np.floor(np.log10(abs(shown)) + 1e-12))
    if -3 <= power < MOST_DIGITS:
        return f"{shown:.{max(0, digits - 1 - power)}f}"
    return f"{shown / 10.0**power:.{digits}g}{_power(power)}"


def _power(exponent: int) -> str:
    return f"·10{str(exponent).translate(SUPERSCRIPT)}"


def _subplots(rows: int = 1, columns: int = 1, **options):
    """Figure and axes that no window and no notebook of the caller knows of."""
    fig = Figure(**{k: options.pop(k) for k in ("figsize", "layout") if k in options})
    return fig, fig.subplots(rows, columns, **options)


def _svg(fig: Figure, bbox: str | None = "tight") -> str:
    """SVG of a figure; ``tight`` makes room for a legend that is wider than it."""
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", bbox_inches=bbox, transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    for colour, variable in CSS.items():
        # A program that does not know the variable takes the colour before it.
        text = re.sub(rf"([\w-]+): {colour}", rf"\1: {PLAIN[colour]}; \1: {variable}", text)
    return text[text.index("<svg") :]


def _logarithmic(axes: np.ndarray) -> None:
    """Both scales of axes that share or have the same x, without minor ticks: each scale once, which takes long."""
    for ax in axes.flat:
        if ax.get_xscale() != "log":
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=FREQUENCIES))
            ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.set_yscale("log")
        ax.minorticks_off()


def _draw_response(
    ax, view: FrfView, row: int, column: int, size: float = 2.0, colours: dict[str, str] | None = None
) -> None:
    """One entry of the FRF: measured with its standard deviation, and both models."""
    ink = {c: (colours or {}).get(c, c) for c in CSS}
    step = max(1, len(view.frequency) // CURVE)
    f = view.frequency[::step]
    entry = (slice(None, None, step), row, column)
    gain, std = np.abs(view.measured[entry]), view.measured_std[entry]
    ax.plot(f, gain, ".", ms=size, mew=0, color=ink[MEASURED], label="measured")
    ax.plot(f, np.abs(view.baseline[entry]), color=ink[BEFORE], lw=0.9, label="baseline")
    ax.plot(f, np.abs(view.extended[entry]), color=ink[AFTER], lw=0.9, label="extended")
    ax.plot(f, np.maximum(std, 1e-12), color=ink[SOFT], lw=0.8, ls=":", label="σ of the measurement")
    seen = gain[np.isfinite(gain) & (gain > 0)]
    if len(seen):
        ax.set_ylim(np.min(seen) * 0.03, np.max(seen) * 3)


def _legend(fig, ax, loc: str = "outside upper center") -> None:
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc=loc, ncols=len(labels), frameon=False, fontsize=8, markerscale=3)


def frf_figure(view: FrfView, joints: tuple[str, ...], unit: str) -> str:
    """Gain of the diagonal entries of one operating point."""
    n = len(joints)
    columns = min(n, 3)
    rows = -(-n // columns)
    with mpl.rc_context(STYLE):
        fig, axes = _subplots(
            rows, columns, figsize=(3.5 * columns, 2.3 * rows + 0.3), sharex=True, squeeze=False, layout="constrained"
        )
        _logarithmic(axes)
        for ax in axes.flat[n:]:
            ax.set_visible(False)
        for j, ax in zip(range(n), axes.flat, strict=False):
            _draw_response(ax, view, j, j, 4.0)
            ax.set_title(joints[j], fontsize=8)
        fig.supxlabel("frequency, Hz", fontsize=8)
        fig.supylabel(unit, fontsize=8)
        _legend(fig, axes[0][0])
        return _svg(fig)


def frf_picture(view: FrfView, joints: tuple[str, ...], shown: list[str], unit: str) -> bytes:
    """Diagonal entries of some joints as PNG on black, for the recording."""
    style = {key: DARK.get(value, value) for key, value in STYLE.items()}
    with mpl.rc_context(style | {"font.size": 9}):
        fig, axes = _subplots(1, len(shown), figsize=(5 * len(shown), 3.1), squeeze=False, layout="constrained")
        _logarithmic(axes)
        for name, ax in zip(shown, axes.flat, strict=True):
            j = joints.index(name)
            _draw_response(ax, view, j, j, 4.0, DARK)
            ax.set_title(name, fontsize=9)
            ax.set_xlabel("frequency, Hz")
        axes[0][0].set_ylabel(unit)
        _legend(fig, axes[0][0])
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png", dpi=150, facecolor="#0d0d0d")
        return buffer.getvalue()


def frf_grid_figure(view: FrfView, joints: tuple[str, ...]) -> str:
    """Gain of all entries of one operating point: torque of the column, acceleration of the row."""
    n = len(joints)
    height = 1.25 * n + 0.6
    with mpl.rc_context(STYLE | {"xtick.labelsize": 5, "ytick.labelsize": 5}):
        # A layout that asks every axis for the size of its labels takes several times as long.
        fig, axes = _subplots(n, n, figsize=(11, height), sharex=True, squeeze=False)
        fig.subplots_adjust(0.06, 0.42 / height, 0.995, 1.0 - 0.48 / height, wspace=0.2, hspace=0.12)
        _logarithmic(axes)
        for i in range(n):
            for j in range(n):
                _draw_response(axes[i][j], view, i, j)
            axes[i][0].set_ylabel(joints[i], fontsize=6)
            axes[0][i].set_title(joints[i], fontsize=6)
        fig.supxlabel("frequency, Hz", fontsize=8, y=0.02 / height)
        _legend(fig, axes[0][0], "upper center")
        return _svg(fig, None)


def where_figure(spectrum: SpectrumMap, joints: tuple[str, ...], unit: str) -> str:
    """Residual over noise by operating point, joint and band, before and after; and the noise."""
    with mpl.rc_context(STYLE | {"axes.grid": False, "axes.spines.left": False, "axes.spines.bottom": False}):
        points, edges = spectrum.operating_points, spectrum.band_edges_hz
        n, rows = len(joints), len(points) * len(joints)
        fig, axes = _subplots(1, 3, figsize=(11, 0.17 * rows + 1.5), sharey=True, layout="constrained")
        noise = np.maximum(spectrum.noise, 1e-12)
        top = max(10.0, float(np.nanmax(spectrum.before / noise)))
        ratio = {"norm": LogNorm(1.0, top, clip=True), "cmap": "YlOrRd"}
        panels = (
            ("baseline: residual ÷ noise", spectrum.before / noise, ratio),
            ("extended: residual ÷ noise", spectrum.after / noise, ratio),
            (f"noise, {unit}", noise, {"norm": LogNorm(), "cmap": "GnBu"}),
        )
        images = []
        for ax, (title, data, options) in zip(axes, panels, strict=True):
            images.append(ax.imshow(data.reshape(rows, -1), aspect="auto", interpolation="nearest", **options))
            for line in range(n, rows, n):
                ax.axhline(line - 0.5, color=INK, lw=0.6)
            names = [f"{a:.2g}–{b:.2g}" for a, b in pairwise(edges)]
            ax.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor", fontsize=6)
            ax.tick_params(length=0)
            ax.set_title(title, fontsize=8)
            ax.set_xlabel("band, Hz")
        axes[0].set_yticks(range(rows), [f"{point}  {joint}" for point in points for joint in joints], fontsize=6)
        for image, ax in ((images[1], axes[:2]), (images[2], axes[2:])):
            bar = fig.colorbar(image, ax=ax, aspect=30, pad=0.01)
            bar.outline.set_visible(False)
            bar.ax.tick_params(which="both", labelsize=6)
        return _svg(fig)


def evidence_figure(plot: EvidencePlot) -> str:
    """Residual torque against the variable that explains it."""
    unknown = plot.cause is None
    residual, law = (
        ("residual", "law that explains most of it") if unknown else ("residual without the cause", "fitted effect")
    )
    with mpl.rc_context(STYLE):
        fig, ax = _subplots(figsize=(5.2, 3.3), layout="constrained")
        ax.plot(*_thin(plot.x, plot.y), ".", ms=2.2, mew=0, alpha=0.45, color=MEASURED, label=residual)
        ax.plot(*_thin(plot.model_x, plot.model_y), ".", ms=2.2, mew=0, alpha=0.7, color=AFTER, label=law)
        ax.set_xlabel(plot.x_label)
        ax.set_ylabel(plot.y_label)
        _legend(fig, ax)
        return _svg(fig)


def shown_joints(
    verdict: Verdict, trace: TorqueTrace | None, joints: Sequence[str], most: int = SHOWN_JOINTS
) -> list[str]:
    """At most so many joints to look at: those of causes, then those at which the discrepancy is, then those of the gain,
    then those with the largest error of the baseline over what the torque changes by. A static error counts."""
    first = [name for c in verdict.causes for name in (c.joint, *c.joints)]
    first += [w.joint for w in sorted(verdict.discrepancy.where, key=lambda w: -w.share)]
    first += verdict.gain.joints if verdict.gain else ()
    rest = list(joints)
    if trace is not None:
        error = np.sqrt(np.mean((trace.measured - trace.before) ** 2, axis=0))
        order = np.argsort(-error / np.maximum(trace.measured.std(axis=0), 1e-9), kind="stable")
        rest = [joints[j] for j in order]
    return [name for name in dict.fromkeys((*first, *rest)) if name in joints][:most]


def trace_figure(trace: TorqueTrace, joints: tuple[str, ...], units: tuple[str, ...], shown: Collection[str]) -> str:
    """Torque errors of both models in time on one segment, of the joints ``shown``, in the order of the arm."""
    worst = [j for j, name in enumerate(joints) if name in shown]
    with mpl.rc_context(STYLE):
        fig, axes = _subplots(
            len(worst), 1, figsize=(11, 1.4 * len(worst) + 0.5), sharex=True, squeeze=False, layout="constrained"
        )
        step = max(1, len(trace.t) // POINTS)
        for ax, j in zip(axes.flat, worst, strict=True):
            t = trace.t[::step]
            ax.plot(t, (trace.measured - trace.before)[::step, j], color=BEFORE, lw=0.7, label="error of the baseline")
            ax.plot(
                t, (trace.measured - trace.after)[::step, j], color=AFTER, lw=0.7, label="error of the extended model"
            )
            ax.set_title(joints[j], fontsize=8, loc="left")
            ax.set_ylabel(units[j])
            ax.margins(x=0)
        _legend(fig, axes[0][0])
        axes[-1][0].set_xlabel("time, s")
        return _svg(fig)


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = max(1, len(x) // POINTS)
    return x[::step], y[::step]
