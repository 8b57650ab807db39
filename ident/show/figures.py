"""Figures of the report, as SVG text."""

from __future__ import annotations

import io

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from ident.verdict import EvidencePlot, FrfView, SpectrumMap, TorqueTrace

MEASURED, BEFORE, AFTER = "#333333", "#c8553d", "#2a7f9e"
STYLE = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "svg.fonttype": "path",
    "figure.facecolor": "white",
}
POINTS = 1500


def _svg(fig) -> str:
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", bbox_inches="tight")
    plt.close(fig)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def frf_figure(view: FrfView, joints: tuple[str, ...]) -> str:
    """Gain of the diagonal entries of one operating point, and the errors of both models."""
    n = len(joints)
    columns = min(n, 3)
    rows = -(-n // columns)
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(rows, columns, figsize=(3.3 * columns, 2.3 * rows), squeeze=False, layout="constrained")
        for ax in axes.flat[n:]:
            ax.set_visible(False)
        for j, ax in zip(range(n), axes.flat, strict=False):
            f = view.frequency
            ax.loglog(f, np.abs(view.measured[:, j, j]), ".", ms=2.5, color=MEASURED, label="measured")
            ax.loglog(f, np.abs(view.baseline[:, j, j]), color=BEFORE, lw=0.9, label="baseline")
            ax.loglog(f, np.abs(view.extended[:, j, j]), color=AFTER, lw=0.9, label="extended")
            ax.loglog(f, np.maximum(view.measured_std[:, j, j], 1e-12), color=MEASURED, lw=0.6, ls=":", label="measured σ")
            ax.set_title(joints[j], fontsize=8)
            ax.set_ylim(bottom=max(1e-7, float(np.abs(view.measured[:, j, j]).min()) * 1e-4))
        axes[-1][0].set_xlabel("frequency, Hz")
        axes[0][0].set_ylabel("(rad/s²)/(N m)")
        axes[0][0].legend(fontsize=6, frameon=False)
        return _svg(fig)


def where_figure(spectrum: SpectrumMap, joints: tuple[str, ...]) -> str:
    """Residual over noise by joint and band, before and after: a heat map per state."""
    with plt.rc_context(STYLE | {"axes.grid": False}):
        n_op = len(spectrum.operating_points)
        fig, axes = plt.subplots(1, 2, figsize=(10, 0.28 * n_op * len(joints) + 1.2), sharey=True, layout="constrained")
        noise = np.maximum(spectrum.noise, 1e-12)
        top = max(10.0, float((spectrum.before / noise).max()))
        labels = [f"{op}  {j}" for op in spectrum.operating_points for j in joints]
        for ax, data, title in zip(axes, (spectrum.before, spectrum.after), ("baseline", "extended"), strict=True):
            ratio = (data / noise).reshape(-1, data.shape[-1])
            image = ax.imshow(ratio, aspect="auto", norm=LogNorm(1.0, top), cmap="magma_r")
            edges = spectrum.band_edges_hz
            ax.set_xticks(range(len(edges) - 1), [f"{a:.3g}–{b:.3g}" for a, b in zip(edges[:-1], edges[1:], strict=True)], rotation=40, ha="right", fontsize=6)
            ax.set_yticks(range(len(labels)), labels, fontsize=6)
            ax.set_title(f"{title}: residual over noise", fontsize=8)
            ax.set_xlabel("band, Hz")
        fig.colorbar(image, ax=axes, shrink=0.8)
        return _svg(fig)


def evidence_figure(plot: EvidencePlot) -> str:
    """Residual torque against the variable that explains it."""
    with plt.rc_context(STYLE):
        fig, ax = plt.subplots(figsize=(5.2, 3.1), layout="constrained")
        ax.plot(*_thin(plot.x, plot.y), ".", ms=1.8, alpha=0.5, color=MEASURED, label="residual without the cause", rasterized=True)
        ax.plot(*_thin(plot.model_x, plot.model_y), ".", ms=1.8, alpha=0.6, color=AFTER, label="fitted effect", rasterized=True)
        ax.set_xlabel(plot.x_label)
        ax.set_ylabel(plot.y_label)
        ax.set_title(plot.title, fontsize=9)
        ax.legend(fontsize=7, frameon=False, markerscale=4)
        return _svg(fig)


def trace_figure(trace: TorqueTrace, joints: tuple[str, ...]) -> str:
    """Torque errors of both models in time on one held-out segment, worst three joints."""
    before = (trace.measured - trace.before).std(axis=0)
    scale = np.maximum(trace.measured.std(axis=0), 1e-9)
    worst = np.sort(np.argsort(-before / scale)[: min(3, len(joints))])
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(len(worst), 1, figsize=(10, 1.5 * len(worst) + 0.5), sharex=True, squeeze=False, layout="constrained")
        step = max(1, len(trace.t) // POINTS)
        for ax, j in zip(axes.flat, worst, strict=True):
            t = trace.t[::step]
            ax.plot(t, (trace.measured - trace.before)[::step, j], color=BEFORE, lw=0.7, label="error before")
            ax.plot(t, (trace.measured - trace.after)[::step, j], color=AFTER, lw=0.7, label="error after")
            ax.set_ylabel(f"{joints[j]}\nN m", fontsize=7)
        axes[0][0].legend(fontsize=7, frameon=False, ncols=2)
        axes[-1][0].set_xlabel("time, s")
        return _svg(fig)


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = max(1, len(x) // POINTS)
    return x[::step], y[::step]
