"""What a blind benchmark comes to: tables, and pictures of confusion, detection and calibration."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

NAMED = 0.5  # probability above which a cause counts as named
TIED = 0.2  # probability above which an alternative counts as tied with the first
SEEN = 3.0  # distortion over noise from which an effect counts as one that the data show
BINS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 1.0001])


def truth_of(row: dict) -> set[tuple[str, str]]:
    return {(t["effect"], t["place"]) for t in row["truth"]}


def kind(row: dict) -> str:
    """none, one, two, or outside."""
    if any(t["effect"].startswith("outside:") for t in row["truth"]):
        return "outside"
    return ("none", "one", "two")[min(len(row["truth"]), 2)]


def named(row: dict) -> set[tuple[str, str]]:
    return {(c["effect"], c["joint"]) for c in row.get("causes", []) if c["probability"] > NAMED}


def tied(cause: dict) -> set[tuple[str, str]]:
    """A cause with the alternatives that it is tied with."""
    others = {(a["effect"], a["joint"]) for a in cause["alternatives"] if a["probability"] > TIED}
    return {(cause["effect"], cause["joint"]), *others}


def statements(rows: list[dict]) -> list[tuple[float, bool]]:
    """Every probability that a verdict gave to a name, and whether the name was right."""
    out = []
    for row in rows:
        wanted = truth_of(row)
        for cause in row.get("causes", []):
            out.append((cause["probability"], (cause["effect"], cause["joint"]) in wanted))
            out += [(a["probability"], (a["effect"], a["joint"]) in wanted) for a in cause["alternatives"]]
    return out


def calibration_error(pairs: list[tuple[float, bool]]) -> float:
    """Expected calibration error over ``BINS``."""
    if not pairs:
        return float("nan")
    p, right = np.array([x for x, _ in pairs]), np.array([y for _, y in pairs], float)
    bin_of = np.digitize(p, BINS) - 1
    return float(
        sum(abs(p[bin_of == b].mean() - right[bin_of == b].mean()) * np.mean(bin_of == b) for b in set(bin_of))
    )


def table(rows: list[dict]) -> str:
    """All figures as text."""
    by_kind = defaultdict(list)
    for row in rows:
        by_kind[kind(row)].append(row)
    out = [f"{len(rows)} cases, {sum('error' in r for r in rows)} failed"]
    for name in ("none", "one", "two", "outside"):
        group = by_kind.get(name, [])
        if not group:
            continue
        n = len(group)
        if name in ("none", "outside"):
            out.append(f"{name:8s} {n:4d}: named {sum(bool(named(r)) for r in group)}")
        else:
            right = sum(named(r) == truth_of(r) for r in group)
            within = sum(truth_of(r) <= {x for c in r.get("causes", []) for x in tied(c)} for r in group)
            some = sum(bool(named(r) & truth_of(r)) for r in group)
            wrong = sum(bool(named(r) - truth_of(r)) for r in group)
            silent = sum(not named(r) for r in group)
            out.append(
                f"{name:8s} {n:4d}: exactly right {right}, right or tied {within}, at least one right {some},"
                f" a wrong name {wrong}, no name {silent}"
            )
    shown = [r for r in by_kind.get("one", []) if r["truth"][0].get("size", np.inf) >= SEEN]
    if len(shown) < len(by_kind.get("one", [])):
        right = sum(named(r) == truth_of(r) for r in shown)
        out.append(f"one, of at least {SEEN:g} times the noise: exactly right {right} of {len(shown)}")
    errors = [e for r in rows for e in r.get("judged", {}).get("errors", [])]
    closed = [
        r["gain"]["gap_closed"] for r in rows if kind(r) in ("one", "two") and (r.get("gain") or {}).get("gap_closed")
    ]
    seconds = [r["diagnosed_s"] for r in rows if "diagnosed_s" in r]
    if errors:
        out.append(f"parameter error: median {np.median(errors):.3%}, 90 % within {np.quantile(errors, 0.9):.2%}")
    if closed:
        out.append(f"gap closed: median {np.median(closed):.4f}, 10 % below {np.quantile(closed, 0.1):.3f}")
    pairs = statements(rows)
    out.append(f"expected calibration error {calibration_error(pairs):.3f} over {len(pairs)} statements")
    if seconds:
        out.append(f"diagnosis: median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s")
    return "\n".join(out)


def pictures(rows: list[dict], path: Path) -> None:
    """Confusion, detection against size and reliability, side by side in one PNG."""
    fig, (confusion, detection, reliability) = plt.subplots(
        1, 3, figsize=(19, 7), width_ratios=(1.5, 1, 1), layout="constrained"
    )
    _confusion(confusion, rows)
    _detection(detection, rows)
    _reliability(reliability, rows)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def _confusion(ax, rows: list[dict]) -> None:
    counts: Counter[tuple[str, str]] = Counter()
    for row in rows:
        hidden = [t["effect"].replace("outside:", "outside ") for t in row["truth"]] or ["nothing"]
        found = sorted(e for e, _ in named(row)) or ["no name"]
        if len(hidden) == 1:
            for f in found:
                counts[(hidden[0], f)] += 1
    left, below = (sorted({k[i] for k in counts}) for i in range(2))
    image = np.array([[counts[(a, b)] for b in below] for a in left])
    ax.imshow(image, cmap="Blues", aspect="auto")
    for y, x in zip(*np.nonzero(image), strict=True):
        ax.text(
            x,
            y,
            str(image[y, x]),
            ha="center",
            va="center",
            color="white" if image[y, x] > image.max() / 2 else "black",
        )
    ax.set_xticks(range(len(below)), [b.replace("_", " ") for b in below], rotation=60, ha="right", fontsize=8)
    ax.set_yticks(range(len(left)), [a.replace("_", " ") for a in left], fontsize=8)
    ax.set_xlabel("named")
    ax.set_ylabel("hidden alone")
    ax.set_title("What was hidden and what was named")


def _detection(ax, rows: list[dict]) -> None:
    for label, color, marker in (("right", "#2a7f9e", "o"), ("no name", "#8a8a8a", "s"), ("wrong", "#c0392b", "x")):
        x, y = [], []
        for row in rows:
            if kind(row) != "one" or "error" in row:
                continue
            state = "right" if named(row) == truth_of(row) else ("wrong" if named(row) - truth_of(row) else "no name")
            if state == label:
                x.append(max(row["truth"][0]["size"], 1e-2))
                y.append(max((c["probability"] for c in row["causes"]), default=0.0))
        ax.semilogx(x, y, marker, color=color, label=label, alpha=0.7)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("distortion over noise")
    ax.set_ylabel("probability of the first name")
    ax.set_ylim(-0.03, 1.03)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False)
    ax.set_title("One effect: detection against size")


def _reliability(ax, rows: list[dict]) -> None:
    pairs = statements(rows)
    p, right = np.array([x for x, _ in pairs]), np.array([y for _, y in pairs], float)
    bin_of = np.digitize(p, BINS) - 1
    ax.plot([0, 1], [0, 1], color="#8a8a8a", lw=1)
    for b in sorted(set(bin_of)):
        inside = bin_of == b
        ax.plot(
            p[inside].mean(), right[inside].mean(), "o", color="#2a7f9e", ms=4 + 2 * np.sqrt(inside.sum()), alpha=0.7
        )
        ax.annotate(
            str(int(inside.sum())), (p[inside].mean(), right[inside].mean()), fontsize=8, ha="center", va="center"
        )
    ax.set_xlabel("probability stated")
    ax.set_ylabel("share that was right")
    ax.grid(alpha=0.3)
    ax.set_title(f"Reliability, expected calibration error {calibration_error(pairs):.3f}")
