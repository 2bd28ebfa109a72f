"""The charts of the suite: each as PNG and SVG, with a CSV of the plotted numbers beside it.

An engine has one colour in all of them, a variant one marker and line style; float32 markers are filled, float64 ones
hollow. Readable at 850 pixels.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import pathlib
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.patches import Patch  # noqa: E402
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter  # noqa: E402
from PIL import Image  # noqa: E402

from . import analysis  # noqa: E402
from .analysis import BATCHES, OURS, PRESETS, RIVAL  # noqa: E402

WIDTH, DPI = 8.5, 150
MARKERS = "osD^vP*X<>hp"
DASHES = ("-", (0, (5, 1.5)), (0, (3, 1, 1, 1)), (0, (1, 1)))
GREY = "#777777"
#: Words that say that we lose.
LOSS = "#8b0000"
TEXT = {"1": "1 world", "1024": "1,024 worlds"}
STEP = 4e-3
STYLE = {
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "figure.facecolor": "white",
    "figure.dpi": DPI,  # text is as wide when it is laid out as when it is saved
    "figure.constrained_layout.w_pad": 0.08,
    "savefig.facecolor": "white",
    "hatch.linewidth": 0.5,
    "hatch.color": "#bbbbbb",
    "svg.hashsalt": "suite",
    "svg.fonttype": "none",
}


# --- names ---


def title_of(engines: dict[str, Any], name: str) -> str:
    return engines[name].title if name in engines else name


def colour_of(engines: dict[str, Any], name: str) -> str:
    return engines[name].colour if name in engines else GREY


def case_title(cases: dict[str, Any], name: str) -> str:
    return cases[name].title if name in cases else name


def look(engines: dict[str, Any], engine: str, variant: str) -> tuple[str, Any]:
    """(marker, line style) of a variant: by its place in the engine's list."""
    names = list(engines[engine].variants) if engine in engines else []
    k = names.index(variant) if variant in names else len(names)
    return MARKERS[k % len(MARKERS)], DASHES[k % len(DASHES)]


def milliseconds(dt: float) -> str:
    return f"{1e3 * dt:.3g} ms"


def duration(s: float) -> str:
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if s >= size:
            return f"{s / size:.3g} {unit}"
    return f"{1e9 * s:.3g} ns"


def power(target: float) -> str:
    """1e-3 for 0.001."""
    mantissa, exponent = f"{target:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def times(factor: float) -> str:
    """12x; 1/12 for a twelfth."""
    if factor < 0.095:
        return f"1/{1 / factor:.0f}"
    return f"{factor:.0f}x" if factor >= 9.95 else f"{factor:.2g}x"


# --- files ---


def _lay_out(fig):
    """Once, not once a file; the second pass is for what sticks out beside the axes."""
    if fig.get_layout_engine() is not None:
        for _ in range(2):
            fig.draw_without_rendering()
        fig.set_layout_engine("none")


def _save(fig, folder, name: str, header: list[str], table: list[list]) -> list[pathlib.Path]:
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{name}.{kind}" for kind in ("png", "svg", "csv")]
    _lay_out(fig)
    memory = io.BytesIO()
    fig.savefig(memory, dpi=DPI)
    Image.open(memory).convert("RGB").quantize(256).save(files[0], optimize=True)  # a third of the bytes
    fig.savefig(files[1], metadata={"Date": None})
    plt.close(fig)
    with files[2].open("w", newline="") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([["" if v is None else v for v in line] for line in table])
    return files


def _styled(draw):
    """Draw under the style of the suite and leave matplotlib as it was."""

    def styled(*args, **kwargs):
        with plt.rc_context(STYLE):
            return draw(*args, **kwargs)

    styled.__doc__, styled.__name__ = draw.__doc__, draw.__name__
    return styled


# --- work against precision ---


def _fit_text(fit: analysis.Slope | None) -> str:
    if fit is None or (fit.slope is None and fit.floor is None):
        return ""
    if fit.slope is None:
        return f" (floor {fit.floor:.0e})"
    return f" (order {fit.slope:.1f})"


def _handle(engines, c: analysis.Curve, fit: analysis.Slope | None) -> Line2D:
    marker, dashes = look(engines, c.engine, c.variant)
    colour = colour_of(engines, c.engine)
    width = "f32" if c.dtype == "float32" else "f64"
    return Line2D(
        [], [], color=colour, marker=marker, ls=dashes, lw=2.2 if c.preset else 1.1, ms=4.5, mew=1,
        mfc=colour if c.dtype == "float32" else "white",
        label=f"{title_of(engines, c.engine)} {c.variant} {width}{_fit_text(fit)}",
    )  # fmt: skip


def _line(ax, engines, c: analysis.Curve, x: np.ndarray, y: np.ndarray, faint: bool = False):
    marker, dashes = look(engines, c.engine, c.variant)
    colour = colour_of(engines, c.engine)
    if faint:
        ax.plot(x, y, color=colour, lw=0.8, alpha=0.35, marker=".", ms=3, zorder=1.5)
        return
    ax.plot(
        x, y, color=colour, ls=dashes, marker=marker, lw=2.2 if c.preset else 1.1, ms=4.5, mew=1,
        mfc=colour if c.dtype == "float32" else "white", alpha=0.9, zorder=3 if c.preset else 2,
    )  # fmt: skip


def _log_limits(values: list[float], pad: float) -> tuple[float, float] | None:
    good = [v for v in values if v is not None and math.isfinite(v) and v > 0]
    if not good:
        return None
    low, high = min(good), max(good)
    room = max((high / low) ** 0.06, pad)
    return low / room, high * room


def _place(fig, ax, wanted: list[tuple[float, float, str, str]], points: list[tuple[float, float]]):
    """Labels at (x, y), the first ones first; those that would cover another one or a point are left out."""
    renderer = fig.canvas.get_renderer()
    dots = ax.transData.transform(np.array(points)) if points else np.zeros((0, 2))
    frame, taken = ax.get_window_extent(renderer), []
    paper = {"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.2}
    for x, y, text, colour in wanted:
        for dx, dy in ((0, 5), (0, -11), (6, -2), (-6, -2), (6, 6), (-6, 6), (6, -10), (-6, -10)):
            align = "center" if dx == 0 else "left" if dx > 0 else "right"
            style = {"color": colour, "fontsize": 6.5, "ha": align, "zorder": 5, "bbox": paper}
            note = ax.annotate(text, (x, y), xytext=(dx, dy), textcoords="offset points", **style)
            box = note.get_window_extent(renderer)
            inside = box.x0 > frame.x0 and box.x1 < frame.x1 and box.y0 > frame.y0 and box.y1 < frame.y1
            if inside and not box.count_contains(dots) and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            note.remove()


def _failed_marks(ax, engines, curves: list[analysis.Curve], batch: str) -> int:
    """Crosses at the top edge at their time, at the right edge where there is none."""
    marks = [(c, r) for c in curves for r in c.failed]
    untimed = [c for c, r in marks if analysis.seconds(r, batch) is None]
    style = {"marker": "x", "ls": "", "ms": 5, "mew": 1.4, "clip_on": False, "zorder": 6}
    for c, r in marks:
        time = analysis.seconds(r, batch)
        if time is not None:
            ax.plot(time, 1.0, color=colour_of(engines, c.engine), transform=ax.get_xaxis_transform(), **style)
    step = min(0.05, 0.95 / max(len(untimed), 1))
    for k, c in enumerate(untimed):
        ax.plot(1.0, 1 - k * step, color=colour_of(engines, c.engine), transform=ax.transAxes, **style)
    return len(marks)


def _staircase(ax, front: list[analysis.Point]):
    if not front:
        return
    right, top = ax.get_xlim()[1], ax.get_ylim()[1]
    x = [front[0].seconds, *(p.seconds for p in front), right]
    y = [top, *(p.error for p in front), front[-1].error]
    ax.step(x, y, where="post", color="#c4c4c4", lw=5, alpha=0.6, zorder=1, solid_joinstyle="round")


def _bound(ax, bound: float):
    low, high = ax.get_ylim()
    if bound > low:
        ax.axhspan(low, min(bound, high), facecolor="#f1f1f1", hatch="////", edgecolor="#bbbbbb", lw=0, zorder=0.5)


def _legend(fig, handles: list, columns: int = 3):
    fig.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=3.6, columnspacing=1.6)


def _shown(curves: list[analysis.Curve], of) -> tuple[list, list]:
    """(curves drawn by themselves, the other variants of ours)."""
    seen = [c for c in curves if c.rows and of(c)]
    main = [c for c in seen if c.engine != OURS or c.variant in PRESETS or "+" in c.variant]
    main.sort(key=lambda c: (not c.preset, c.engine != OURS, c.engine != RIVAL))
    return main, [c for c in seen if c not in main]


@_styled
def work_precision(rows: list, cases: dict, engines: dict, folder, case: str) -> list[pathlib.Path]:
    """Error against wall time per simulated second and world, for one world and 1,024; [] where no error is known."""
    curves = analysis.curves(rows, case)
    here = cases[case]
    main, faint = _shown(curves, lambda c: np.isfinite(c.column("error")).any())
    if not main:
        return []
    count = len(main) + 4
    fig, axes = plt.subplots(
        1, 2, figsize=(WIDTH, 4.0 + 0.155 * math.ceil(count / 3)), sharey=True, layout="constrained"
    )  # fmt: skip
    values = [v for c in main + faint for v in c.column("error")]
    limits = _log_limits(values, 1.6) or (here.bound / 10 or 1e-16, here.bound * 10 or 1e-14)  # all errors are 0
    table, labels, crosses, partly = [], [], 0, False
    for ax, batch in zip(axes, BATCHES):
        ax.set(xscale="log", yscale="log", title=TEXT[batch], xlabel="wall seconds per simulated second and world")
        low = limits[0] / 1.5 if here.bound < limits[0] else min(limits[0], here.bound / 3)
        ax.set_ylim(low, limits[1] * 1.5)
        bottom = ax.get_ylim()[0]
        timed = [v for c in main + faint for v in c.time(batch)]
        timed += [v for c in curves for r in c.failed if (v := analysis.seconds(r, batch))]
        if wide := _log_limits(timed, 1.5):
            ax.set_xlim(*wide)
            _few_ticks(ax.xaxis)
        else:
            ax.text(0.5, 0.5, "not timed", transform=ax.transAxes, ha="center", color=GREY)
        _few_ticks(ax.yaxis)
        wanted, dots = [], []
        for c in faint + main:
            x, y = c.time(batch), c.column("error")
            keep = np.isfinite(x) & np.isfinite(y)
            drawn = np.maximum(y[keep], bottom)  # an error of exactly 0 lies on the lower edge
            _line(ax, engines, c, x[keep], drawn, faint=c in faint)
            dots += zip(x[keep], drawn)
            lost = np.nan_to_num(c.column("error", "failed_worlds")[keep]) > 0
            ax.plot(x[keep][lost], drawn[lost], "kx", ms=3, mew=0.8, zorder=4)
            partly |= bool(lost.any())
            table += [_csv_point(r, batch, "ok") for r, k in zip(c.rows, keep) if k]
            if c in main and keep.any():
                dt, colour = c.dt[keep], colour_of(engines, c.engine)
                ends = sorted({0, len(dt) - 1})
                wanted += [(x[keep][k], drawn[k], milliseconds(dt[k]), colour) for k in ends]
        front = analysis.points([r for c in curves for r in c.rows], batch)
        _staircase(ax, [front[i] for i in analysis.pareto(front, here.bound)])
        _bound(ax, here.bound)
        crosses += _failed_marks(ax, engines, curves, batch)
        table += [_csv_point(r, batch, "failed") for c in curves for r in c.failed]
        first = [colour_of(engines, OURS), colour_of(engines, RIVAL)]
        labels.append((sorted(wanted, key=lambda w: first.index(w[3]) if w[3] in first else 2), dots))
    axes[0].set_ylabel(f"error against truth:\n{here.unit}")
    handles = [_handle(engines, c, c.order) for c in main]
    if faint:
        label = f"{title_of(engines, OURS)}, other integrators, solvers"
        handles.append(Line2D([], [], color=colour_of(engines, OURS), lw=0.8, alpha=0.5, marker=".", ms=3, label=label))
    handles.append(Line2D([], [], color="#c4c4c4", lw=5, alpha=0.6, label="front: nothing faster is as exact"))
    if here.bound > axes[0].get_ylim()[0]:
        handles.append(
            Patch(fc="#f1f1f1", ec="#bbbbbb", hatch="////", lw=0, label=f"truth not known below {here.bound:.0e}")
        )
    if crosses:
        handles.append(Line2D([], [], color="k", marker="x", ls="", ms=5, label="failed (right edge: no time)"))
    if partly:
        handles.append(
            Line2D([], [], color="k", marker="x", ls="", ms=3, mew=0.8, label="on a point: some worlds failed")
        )
    skipped = sum(c.skipped for c in curves)
    tail = f"   [{skipped} points skipped: over the budget of time]" if skipped else ""
    fig.suptitle(f"{here.title}: error against cost{tail}", fontsize=10.5, x=0.01, ha="left")
    _legend(fig, handles)
    _lay_out(fig)
    for ax, (wanted, dots) in zip(axes, labels):
        _place(fig, ax, wanted, dots)
    return _save(fig, folder, f"work_precision_{case}", POINT_HEADER, table)


POINT_HEADER = [
    "case", "engine", "variant", "dtype", "dt", "batch", "status", "seconds", "seconds_low", "seconds_high",
    "error", "error_p10", "error_p90", "failed_worlds", "self_error",
]  # fmt: skip


def _csv_point(row: dict, batch: str, status: str) -> list:
    time = [analysis.seconds(row, batch, part) for part in ("median", "low", "high")]
    error = [analysis.value(row, "error", part) for part in ("median", "p10", "p90", "failed_worlds")]
    return [*analysis.key(row), batch, status, *time, *error, analysis.value(row, "self_error")]


@_styled
def convergence(rows: list, cases: dict, engines: dict, folder, case: str) -> list[pathlib.Path]:
    """Error against truth, and difference from the engine's own limit, against the step; [] where neither is known.

    A row of panels for the presets and the other engines, one for the other variants of ours.
    """
    curves = analysis.curves(rows, case)
    here = cases[case]
    known = lambda c: np.isfinite(c.column("error")).any() or np.isfinite(c.column("self_error")).any()
    groups = [g for g in _shown(curves, known) if g]
    if not groups:
        return []
    lines = [math.ceil((len(g) + 1) / 3) for g in groups]
    fig = plt.figure(figsize=(WIDTH, sum(3.6 + 0.16 * n for n in lines) + 0.3), layout="constrained")
    parts = fig.subfigures(len(groups), 1, height_ratios=[3.6 + 0.16 * n for n in lines], squeeze=False)[:, 0]
    what = (("error", f"error: {here.unit}"), ("self_error", "difference from the engine's own limit"))
    table = []
    for part, group in zip(parts, groups):
        axes = part.subplots(1, 2)
        for ax, (name, label) in zip(axes, what):
            ax.set(xscale="log", yscale="log", xlabel="step [ms]", title=label)
            limits = _log_limits([v for c in group for v in c.column(name)], 1.6)
            if limits is None:
                ax.text(0.5, 0.5, "0 or not known", transform=ax.transAxes, ha="center", color=GREY)
                ax.set(xticks=[], yticks=[])
                continue
            ax.set_ylim(limits)
            _few_ticks(ax.yaxis)
            for c in group:
                y = c.column(name)
                keep = np.isfinite(y)
                _line(ax, engines, c, 1e3 * c.dt[keep], np.maximum(y[keep], limits[0]))
            _step_axis(ax)
            if name == "error":
                _bound(ax, here.bound)
        table += [_csv_step(c, r) for c in group for r in c.rows]
        handles = []
        for c in group:
            handle = _handle(engines, c, None)
            orders = [f"{f.slope:.1f}" if f and f.slope is not None else "-" for f in (c.order, c.self_order)]
            handle.set_label(f"{handle.get_label()} ({' | '.join(orders)})")
            handles.append(handle)
        part.legend(handles=handles, loc="outside lower center", ncols=3, handlelength=3.6, columnspacing=1.6)
    fig.suptitle(
        f"{here.title}: convergence; in brackets the order in dt above the floor, left | right panel",
        fontsize=10, x=0.01, ha="left",
    )  # fmt: skip
    header = [
        "case",
        "engine",
        "variant",
        "dtype",
        "dt",
        "error",
        "self_error",
        "order",
        "floor",
        "self_order",
        "self_floor",
    ]
    return _save(fig, folder, f"convergence_{case}", header, table)


def _csv_step(c: analysis.Curve, row: dict) -> list:
    fits = [(f.slope, f.floor) if f else (None, None) for f in (c.order, c.self_order)]
    return [*analysis.key(row), analysis.value(row), analysis.value(row, "self_error"), *fits[0], *fits[1]]


def _few_ticks(axis):
    """Labels at 1, 2, 5 where less than a decade and a half is shown, else at powers of ten."""
    low, high = axis.get_view_interval()
    if high / low < 30:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.0e}".replace("e-0", "e-").replace("e+0", "e")))
    axis.set_minor_formatter(NullFormatter())


def _step_axis(ax):
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


# --- cases side by side ---


def _ordered(cases: dict, names: set) -> list[str]:
    """Cases group by group, the groups in the order of their first case."""
    groups = list(dict.fromkeys(c.group for c in cases.values()))
    return sorted((n for n in cases if n in names), key=lambda n: groups.index(cases[n].group))


def _case_axis(ax, cases: dict, names: list[str]):
    """Cases from top to bottom with a line between groups."""
    ax.set_yticks(range(len(names)), [cases[n].title for n in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    for k in range(1, len(names)):
        if cases[names[k]].group != cases[names[k - 1]].group:
            ax.axhline(k - 0.5, color="#b8b8b8", lw=0.8, clip_on=False)


def _factor_axis(axis, low: float, high: float):
    few = math.log10(high / low) < 3.2
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,), numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}x"))
    axis.set_minor_formatter(NullFormatter())


@_styled
def overview(
    rows: list, cases: dict, engines: dict, folder, target: float = 1e-3, batch: str = "1024"
) -> list[pathlib.Path]:
    """How many times our time MuJoCo C and the best other engine take to reach ``target``; [] without cases."""
    judged = analysis.verdicts(rows, cases, (target,))
    here = {v.case: v.targets[target] for v in judged.cases if v.batch == batch and target in v.targets}
    found = {name: r for name, r in here.items() if r.tried - {OURS}}
    names = _ordered(cases, set(found))
    if not names:
        return []
    finite = [f for r in found.values() for w in ("mujoco", "peer") if (f := r.factor(w)) and math.isfinite(f)]
    low, high = min([0.5, *finite]), max([10.0, *finite])
    room = max(1.6, (high / low) ** 0.09)
    low, high = low / room, high * room
    fig, ax = plt.subplots(figsize=(WIDTH, 0.36 * len(names) + 1.75), layout="constrained")
    ax.set(xscale="log", xlim=(low, high), xlabel=f"{title_of(engines, OURS)} is so many times as fast")
    _case_axis(ax, cases, names)
    _factor_axis(ax.xaxis, low, high)
    ax.axvspan(low, 1, color="#f6e3e0", lw=0, zorder=0)
    ax.axvline(1, color="k", lw=1.1, zorder=1)
    ax.axvline(analysis.BAR, color="k", lw=0.9, ls=":", zorder=1)
    for x, text in ((1, "1x"), (analysis.BAR, "5x")):
        ax.text(x, 1.005, text, transform=ax.get_xaxis_transform(), ha="center", va="bottom", fontsize=8)
    table, peers = [], set()
    for k, name in enumerate(names):
        peers |= _overview_row(ax, engines, k, found[name], (low, high))
        r = found[name]
        table.append([
            name, cases[name].group, target, batch, *(p.seconds if p else None for p in (r.ours, r.mujoco, r.peer)),
            r.peer_name, r.factor("mujoco"), r.factor("peer"), r.ours.label if r.ours else None,
        ])  # fmt: skip
    ax.text(1.015, 1.005, "best other", transform=ax.transAxes, va="bottom", fontsize=7.5, color=GREY)
    _overview_legend(fig, engines, peers, found.values())
    fig.suptitle(
        f"Time to reach an error of {power(target)}, over the time of {title_of(engines, OURS)} ({TEXT[batch]})",
        fontsize=10.5, x=0.01, ha="left",
    )  # fmt: skip
    header = [
        "case", "group", "target", "batch", "ours_s", "mujoco_s", "peer_s", "peer", "mujoco_over_ours",
        "peer_over_ours", "ours_by",
    ]  # fmt: skip
    return _save(fig, folder, f"overview_{batch}", header, table)


def _say(ax, text: str, x: float, y: float, dx: float, colour: str, dy: float = 0, **style):
    """A word beside a mark, to the right of it where dx > 0."""
    style = {"va": "center" if dy == 0 else "baseline", "fontsize": 7.5, "color": colour, **style}
    ax.annotate(text, (x, y), xytext=(dx, dy), textcoords="offset points", ha="left" if dx > 0 else "right", **style)


def _overview_row(ax, engines, y: int, r: analysis.Reached, limits: tuple[float, float]) -> set[str]:
    """Marks of one case; returns the other engines that it named."""
    low, high = limits
    edge = {"transform": ax.get_yaxis_transform(), "clip_on": False}
    if r.peer and r.ours:
        factor = r.factor("peer")
        word = f"{title_of(engines, r.peer_name)} {times(factor)}"
        ax.text(1.015, y, word, va="center", fontsize=7.5, color=LOSS if factor < 1 else "k", **edge)
        style = {"mfc": colour_of(engines, r.peer_name), "mec": "white", "mew": 0.7, "ms": 6.5}
        ax.plot(factor, y, marker="D", zorder=5, **style)
    elif r.ours:
        ax.text(
            1.015, y, "never" if r.tried - {OURS, RIVAL} else "none run", va="center", fontsize=7.5, color=GREY, **edge
        )
    if r.ours is None:
        reach = [title_of(engines, w) for w in (RIVAL if r.mujoco else None, r.peer_name) if w]
        us = title_of(engines, OURS)
        text = f"no preset of {us} reaches it ({' and '.join(reach)} can)" if reach else "nobody reaches it"
        if r.own:
            text += (
                f"; variant {r.own.row['variant']} of {us} does" if reach else f" but variant {r.own.row['variant']}"
            )
        colour = LOSS if reach else GREY
        ax.plot(0.018, y, marker="X", color=colour, ms=8, zorder=4, **edge)
        ax.text(0.035, y, text, va="center", fontsize=7.5, color=colour, transform=ax.get_yaxis_transform())
    elif RIVAL not in r.tried:
        _say(ax, f"{title_of(engines, RIVAL)} not run", high, y, -4, GREY)
    elif r.mujoco is None:
        red = colour_of(engines, RIVAL)
        ax.plot([1, high], [y, y], color=red, lw=1.2, ls=(0, (1, 1.6)), zorder=2)
        ax.plot(0.988, y, marker=">", mfc="white", mec=red, mew=1.6, ms=9, zorder=4, **edge)
        _say(ax, "never", high, y, -16, red, 3)
    else:
        red, factor = colour_of(engines, RIVAL), r.factor("mujoco")
        ax.plot([1, factor], [y, y], color=red, lw=3.4, solid_capstyle="butt", zorder=2)
        ax.plot(factor, y, marker="o", color=red, ms=7, zorder=4)
        _say(ax, times(factor), factor, y, 6 if factor >= 1 else -6, LOSS if factor < 1 else red, 3)
    return {r.peer_name} - {None} if r.ours else set()


def _overview_legend(fig, engines, peers: set[str], found):
    red = colour_of(engines, RIVAL)
    handles = [Line2D([], [], color=red, marker="o", lw=3, ms=7, label=f"{title_of(engines, RIVAL)}")]
    if any(r.ours and RIVAL in r.tried and not r.mujoco for r in found):
        handles.append(
            Line2D([], [], color=red, marker=">", mfc="white", mew=1.6, ms=8, ls=(0, (1, 1.6)),
                   label=f"{title_of(engines, RIVAL)} never reaches it")
        )  # fmt: skip
    for name in [n for n in engines if n in peers]:
        label = f"best other: {title_of(engines, name)}"
        handles.append(Line2D([], [], color=colour_of(engines, name), marker="D", ls="", ms=6.5, label=label))
    handles.append(Patch(fc="#f6e3e0", label=f"{title_of(engines, OURS)} is slower"))
    if any(r.ours is None for r in found):
        handles.append(
            Line2D([], [], color=LOSS, marker="X", ls="", ms=8, label=f"no preset of {title_of(engines, OURS)} does")
        )
    _legend(fig, handles)


@_styled
def targets(rows: list, cases: dict, engines: dict, folder, batch: str = "1024") -> list[pathlib.Path]:
    """Time to reach the errors 1e-2, 1e-3 and 1e-4, per case: ours, MuJoCo C and the best other engine."""
    judged = analysis.verdicts(rows, cases)
    found = {v.case: v for v in judged.cases if v.batch == batch}
    names = _ordered(cases, set(found))
    if not names:
        return []
    asked = analysis.TARGETS
    fig, axes = plt.subplots(1, len(asked), figsize=(WIDTH, 0.46 * len(names) + 1.5), sharey=True, layout="constrained")
    all_times = [p.seconds for v in found.values() for r in v.targets.values() for p in (r.ours, r.mujoco, r.peer) if p]
    limits = (min(all_times) / 3, max(all_times) * 6) if all_times else (1e-6, 1.0)
    table, peers = [], set()
    for ax, target in zip(axes, asked):
        ax.set(xscale="log", xlim=limits, title=f"error {power(target)}")
        _case_axis(ax, cases, names)
        ax.xaxis.set_major_locator(LogLocator(numticks=6))
        for k, name in enumerate(names):
            r = found[name].targets.get(target)
            if r is None:
                ax.text(limits[0] * 1.3, k, "truth too coarse", va="center", fontsize=5.5, color=GREY)
                continue
            shown = [(OURS, r.ours), (RIVAL, r.mujoco)]
            if r.tried - {OURS, RIVAL}:
                shown.append((r.peer_name, r.peer))
            for slot, (engine, point) in enumerate(shown):
                y = k + 0.26 * (slot - 1)
                _target_bar(ax, engines, y, engine, point, engine is None or engine in r.tried, limits)
                who = engine or "any other"
                table.append([name, target, batch, who, *((point.seconds, point.label) if point else ("never", None))])
            peers |= {r.peer_name} - {None}
    axes[len(asked) // 2].set_xlabel("wall seconds per simulated second and world")
    handles = [Patch(fc=colour_of(engines, n), label=title_of(engines, n)) for n in (OURS, RIVAL)]
    handles += [
        Patch(fc=colour_of(engines, n), label=f"best other: {title_of(engines, n)}") for n in engines if n in peers
    ]  # fmt: skip
    handles.append(Line2D([], [], marker="s", mfc="white", mec="k", ls="", ms=6, label="never reaches it"))
    _legend(fig, handles, 4)
    fig.suptitle(f"Time to reach an error ({TEXT[batch]}); less is better", fontsize=10.5, x=0.01, ha="left")
    return _save(fig, folder, f"targets_{batch}", ["case", "target", "batch", "engine", "seconds", "by"], table)


def _target_bar(ax, engines, y: float, engine: str | None, point, tried: bool, limits: tuple[float, float]):
    colour = colour_of(engines, engine) if engine else GREY
    if point:
        ax.barh(y, point.seconds - limits[0], left=limits[0], height=0.24, color=colour)
        return
    x = limits[0] * 1.5
    if tried:
        ax.plot(x, y, marker="s", mfc="white", mec=colour, mew=1.2, ms=4.5)
    word = "never" if tried else "not run"
    ax.annotate(word, (x, y), xytext=(5, 0), textcoords="offset points", va="center", fontsize=5.5, color=colour)


# --- speed alone ---


def _nearest(rows: list[dict], batch: str, dt: float = STEP) -> list[dict]:
    """Of each case, engine, variant and dtype the timed point with the step nearest to ``dt``."""
    best = {}
    for row in analysis.latest(rows):
        if analysis.ok(row) and analysis.seconds(row, batch) is not None:
            name = analysis.key(row)[:4]
            off = lambda r: abs(math.log(r["dt"] / dt))
            if name not in best or off(row) < off(best[name]):
                best[name] = row
    return list(best.values())


@_styled
def features(rows: list, cases: dict, engines: dict, folder) -> list[pathlib.Path]:
    """Time of one step of one of 1,024 worlds by preset "fast", the cases by the features that they use."""
    found = {}
    for row in _nearest(rows, "1024"):
        if row["engine"] == OURS and row["variant"] == "fast" and row["case"] in cases:
            found.setdefault(row["case"], {})[row["dtype"]] = row
    names = sorted(found, key=lambda n: (len(cases[n].features), sorted(cases[n].features), len(cases[n].parts)))
    if not names:
        return []
    fig, ax = plt.subplots(figsize=(WIDTH, 0.36 * len(names) + 1.3), layout="constrained")
    spent = [1e6 * analysis.seconds(r, "1024") * r["dt"] for widths in found.values() for r in widths.values()]
    ax.set(xscale="log", xlim=(min(spent) / 2, 3 * max(spent)))
    colour, table = colour_of(engines, OURS), []
    steps = {row["dt"] for widths in found.values() for row in widths.values()}
    at = f", steps of {milliseconds(*steps)}" if len(steps) == 1 else ""
    for k, name in enumerate(names):
        for slot, dtype in enumerate(("float32", "float64")):
            row = found[name].get(dtype)
            if row is None:
                continue
            step = analysis.seconds(row, "1024") * row["dt"]
            ax.barh(
                k + 0.36 * (slot - 0.5),
                1e6 * step,
                height=0.34,
                color=colour if slot == 0 else "white",
                ec=colour,
                lw=1,
            )
            text = f" {duration(step)}" + (f" (step {milliseconds(row['dt'])})" if len(steps) > 1 else "")
            ax.text(1e6 * step, k + 0.36 * (slot - 0.5), text, va="center", fontsize=6.5)
            table.append([name, " ".join(sorted(cases[name].features)), len(cases[name].parts), dtype, row["dt"], step])
    used = lambda n: ", ".join(sorted(cases[n].features)) or "translation alone"
    label = lambda n: f"{cases[n].title}\n{used(n)}; bodies: {len(cases[n].parts)}"
    ax.set_yticks(range(len(names)), [label(n) for n in names], fontsize=7)
    ax.set(ylim=(len(names) - 0.5, -0.5), xlabel="time of one step of one world [us]")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="y", visible=False)
    _legend(fig, [Patch(fc=colour, ec=colour, label="float32"), Patch(fc="white", ec=colour, label="float64")])
    fig.suptitle(
        f"What the features cost: preset fast of {title_of(engines, OURS)}, 1,024 worlds{at}",
        fontsize=10.5,
        x=0.01,
        ha="left",
    )
    return _save(fig, folder, "features", ["case", "features", "bodies", "dtype", "dt", "seconds_a_step"], table)


@_styled
def throughput(rows: list, cases: dict, engines: dict, folder) -> list[pathlib.Path]:
    """World-steps per second of every engine on every case, by its fastest variant at the step nearest to 4 ms."""
    best = {}
    for batch in BATCHES:
        for row in _nearest(rows, batch):
            place = row["case"], row["engine"], batch
            rate = 1 / (analysis.seconds(row, batch) * row["dt"])
            if row["case"] in cases and (row["engine"] != OURS or row["variant"] in PRESETS):
                if place not in best or rate > best[place][0]:
                    best[place] = rate, row
    names = _ordered(cases, {c for c, _, _ in best})
    if not names:
        return []
    fig, axes = plt.subplots(1, 2, figsize=(WIDTH, 0.3 * len(names) + 1.6), sharey=True, layout="constrained")
    shown = [
        e for e in dict.fromkeys([OURS, RIVAL, *engines, *(e for _, e, _ in best)]) if any(e == p[1] for p in best)
    ]
    table = []
    for ax, batch in zip(axes, BATCHES):
        ax.set(xscale="log", title=TEXT[batch], xlabel="world-steps per second")
        _case_axis(ax, cases, names)
        for k in range(len(names)):
            ax.axhline(k, color="#e4e4e4", lw=0.7, zorder=0)
        for engine in shown:  # the smaller marks on the larger
            marks = [(best[n, engine, batch], k) for k, n in enumerate(names) if (n, engine, batch) in best]
            style = {OURS: ("o", 8), RIVAL: ("D", 6.5)}.get(engine, ("s", 5))
            ax.plot(
                [rate for (rate, _), _ in marks], [k for _, k in marks], ls="", marker=style[0], ms=style[1],
                color=colour_of(engines, engine), mec="white", mew=0.6,
            )  # fmt: skip
            table += [
                [names[k], engine, batch, row["variant"], row["dtype"], row["dt"], rate] for (rate, row), k in marks
            ]
        _few_ticks(ax.xaxis)
    marks = {OURS: "o", RIVAL: "D"}
    handles = [
        Line2D([], [], color=colour_of(engines, e), marker=marks.get(e, "s"), ls="", ms=6, label=title_of(engines, e))
        for e in shown
    ]
    _legend(fig, handles, 6)
    fig.suptitle(
        "Speed alone: fastest variant at the step nearest to 4 ms, whatever its error", fontsize=10.5, x=0.01, ha="left"
    )
    header = ["case", "engine", "batch", "variant", "dtype", "dt", "world_steps_per_s"]
    return _save(fig, folder, "throughput", header, sorted(table, key=str))


@_styled
def compile_time(rows: list, cases: dict, engines: dict, folder) -> list[pathlib.Path]:
    """Seconds until a program for 1,024 worlds is compiled: median over steps, per case, engine and variant."""
    gathered: dict = {}
    for row in analysis.latest(rows):
        known = analysis.compiled(row, "1024")
        preset = row["engine"] != OURS or row["variant"] in PRESETS
        if analysis.ok(row) and known is not None and known > 0 and preset and row["case"] in cases:
            place = row["engine"], row["variant"] if row["engine"] == OURS else "", row["dtype"]
            gathered.setdefault(place, {}).setdefault(row["case"], []).append(known)
    names = _ordered(cases, {c for found in gathered.values() for c in found})
    if not names:
        return []
    rank = lambda names, n: list(names).index(n) if n in names else len(names)
    places = sorted(gathered, key=lambda p: (rank(engines, p[0]), rank(PRESETS, p[1]), p[2]))
    places = [p for p in places if p[0] != OURS or p[2] == "float32" or (*p[:2], "float32") not in gathered]
    thick = 0.8 / len(places)
    fig, ax = plt.subplots(figsize=(WIDTH, (0.065 * len(places) + 0.1) * len(names) + 1.4), layout="constrained")
    hatches = dict(zip(PRESETS, ("", "////", "....", "xxxx")))
    table, handles = [], []
    for slot, place in enumerate(places):
        colour = colour_of(engines, place[0])
        style = {"color": colour} if not hatches.get(place[1]) else {
            "facecolor": "white", "edgecolor": colour, "hatch": hatches[place[1]], "lw": 0.8}  # fmt: skip
        for k, name in enumerate(names):
            if name in gathered[place]:
                middle = float(np.median(gathered[place][name]))
                ax.barh(k + thick * (slot - (len(places) - 1) / 2), middle, height=0.9 * thick, **style)
                table.append([name, *place, middle])
        width = "" if place[2] == "float32" else f" {place[2]}"
        handles.append(Patch(**style, label=f"{title_of(engines, place[0])} {place[1]}{width}".strip()))
    _case_axis(ax, cases, names)
    ax.set(xlabel="seconds")
    _legend(fig, handles, 4)
    fig.suptitle(
        "Compile time, program for 1,024 worlds (engines without a compiler: none)", fontsize=10.5, x=0.01, ha="left"
    )
    return _save(fig, folder, "compile_time", ["case", "engine", "variant", "dtype", "seconds"], table)


# --- all of them ---


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A chart: ``name``, ``title`` in words, ``case`` ("" where it is of all), files (PNG, SVG, CSV)."""

    name: str
    title: str
    case: str
    files: tuple[pathlib.Path, ...]

    @property
    def png(self) -> pathlib.Path:
        return self.files[0]


def draw(rows: list, cases: dict, engines: dict, folder) -> list[Drawn]:
    """Every chart that the rows bear."""
    given = (rows, cases, engines, folder)
    drawn = []

    def add(title, files, case=""):
        if files:
            drawn.append(Drawn(files[0].stem, title, case, tuple(files)))

    add("Overview, 1,024 worlds", overview(*given))
    add("Overview, 1 world", overview(*given, batch="1"))
    add("Time to reach an error, 1,024 worlds", targets(*given))
    add("Time to reach an error, 1 world", targets(*given, batch="1"))
    add("Cost of the features", features(*given))
    add("Speed alone", throughput(*given))
    add("Compile time", compile_time(*given))
    for name in _ordered(cases, {r["case"] for r in rows if r.get("kind") == "point"}):
        add(f"{cases[name].title}: error against cost", work_precision(*given, name), name)
        add(f"{cases[name].title}: convergence", convergence(*given, name), name)
    return drawn
