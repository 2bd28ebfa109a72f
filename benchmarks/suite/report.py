"""The pages of the suite: ``suite.html``, which holds all that it shows, and ``suite.md``, the figures in words."""

from __future__ import annotations

import base64
import collections
import html
import math
import pathlib
import re
from collections.abc import Sequence
from typing import Any

from . import analysis, charts
from .analysis import BATCHES, OURS, RIVAL, TARGETS
from .charts import TEXT, case_title, duration, milliseconds, power, times, title_of

#: Rows of the table of changes; the rest is counted.
CHANGES = 40
#: A section that is too long for the Markdown.
PAGE_ONLY = "Orders and floors of the other variants of rbd_jax"

READING = """\
Every point is one engine with one variant, one dtype and one step on one case: its error against rigid truth \
(the median of some worlds with random starts) and its wall time per simulated second and world. Down is more \
exact, left is faster. The grey staircase is the front: no point is both faster and more exact than one on it. \
Nothing is interpolated: "the time to reach an error" is that of the cheapest measured point with at most that \
error. Crosses are points that crashed, hung or diverged, at the upper edge at their time, at the right edge \
where there is no time. Points over the budget of time were skipped and are only counted. Below the hatched line \
the truth itself is not known.

For 1 world the time is latency: one world alone. For 1,024 worlds it is throughput on all cores, divided by the \
number of worlds; for an engine without threads of its own the time is divided by the number of cores, as if one \
process a core ran. Compilation is not in these times; it has its own chart.

A curve that no longer falls has reached its floor. Three kinds are seen:

- float32 rounding: near 1e-7 of the size of the motion, more where it adds up over many steps, so that the \
error rises again at small steps. The same variant in float64 goes on.
- solver tolerance or compliance: iterations that end before contact is solved, or a contact that is soft by \
design, leave an error that does not depend on the step.
- events: a method whose steps do not hit the instant of an impact is of first order at best, in jumps, however \
high the order of its integrator; variants with "+events" hit it.

The order of a curve is the least-squares slope of log error over log step above its floor, from at least three \
points. "Difference from the engine's own limit" compares an engine with itself at a tiny step: it shows the \
order of the method even where its contact law differs from the rigid one, and says nothing about the truth."""


# --- words ---


def _row(*cells) -> str:
    return "| " + " | ".join(str(c).replace("|", "\\|").replace("\n", " ") for c in cells) + " |"


def _table(header: Sequence[str], lines: Sequence[Sequence]) -> list[str]:
    return [_row(*header), "|" + "---|" * len(header), *(_row(*line) for line in lines), ""]


def _by(engines, point: analysis.Point) -> str:
    return f"{title_of(engines, point.row['engine'])} ({point.label})"


def _spent(point: analysis.Point | None) -> str:
    return f"{duration(point.seconds)} ({point.label})" if point else "never"


def _factor(factor: float | None) -> str:
    if factor is None:
        return "neither"
    if factor == 0:
        return "rbd_jax never"
    return "only rbd_jax" if factor == math.inf else times(factor)


def _winner(engines, r: analysis.Reached) -> str:
    """Who is first at an error, and by which factor before whom."""
    other, us = r.other, r.ours
    if us is None:
        if other:
            return f"**{_by(engines, other)}**, no preset of rbd_jax"
        return f"nobody but {_by(engines, r.own)}" if r.own else "nobody"
    if other is None:
        return f"{_by(engines, us)}, nobody else" if r.tried - {OURS} else f"{_by(engines, us)}, run alone"
    first, second = (us, other) if us.seconds <= other.seconds else (other, us)
    ratio, beaten = times(second.seconds / first.seconds), title_of(engines, second.row["engine"])
    text = f"{_by(engines, first)}, {ratio} before {beaten}"
    return text if first is us else f"**{text}**"


def _losses(verdicts: analysis.Verdicts, cases, engines) -> list[str]:
    """A sentence for every case, batch and error at which another engine is first, and for fronts without us."""
    found = []
    for v in verdicts.cases:
        name = f"{case_title(cases, v.case)}, {TEXT[v.batch]}"
        for r in v.targets.values():
            other = r.other
            if other and r.ours is None:
                more = f"; {r.own.label} of ours does" if r.own else ""
                found.append(
                    f"{name}, error {power(r.target)}: no preset reaches it{more}; {_by(engines, other)} does."
                )
            elif other and other.seconds < r.ours.seconds:
                ratio = times(r.ours.seconds / other.seconds)
                found.append(
                    f"{name}, error {power(r.target)}: {_by(engines, other)} takes 1/{ratio[:-1]} of our time."
                )
        if not v.on_front:
            found.append(f"{name}: no preset of ours is on the front.")
    return found


def _shares(verdicts: analysis.Verdicts) -> list[str]:
    lines = []
    for s in verdicts.shares:
        if s.asked:
            of = lambda n, s=s: f"{n} of {s.asked}"
            lines.append([TEXT[s.batch], power(s.target), of(s.bar), of(s.alone), of(s.ahead), of(s.never)])
    text = _table(
        ["worlds", "error", "at most a fifth of MuJoCo's time", "of these, MuJoCo never reaches it",
         "less time than MuJoCo", "only MuJoCo reaches it"], lines,
    )  # fmt: skip
    for batch, (k, n) in verdicts.fronts.items():
        if n:
            text.append(f"A preset of ours is on the front in {k} of {n} cases ({TEXT[batch]}).")
    return [*text, ""]


def _winners(verdicts: analysis.Verdicts, cases, engines, batch: str) -> list[str]:
    lines = []
    for name in cases:
        if v := verdicts.of(name, batch):
            cells = [_winner(engines, v.targets[t]) if t in v.targets else "truth too coarse" for t in TARGETS]
            lines.append([case_title(cases, name), *cells, "yes" if v.on_front else "**no**"])
    return _table(["case", *(f"error {power(t)}" for t in TARGETS), "ours on the front"], lines)


def _targets(verdicts: analysis.Verdicts, cases, engines, batch: str) -> list[str]:
    lines = []
    for name in cases:
        v = verdicts.of(name, batch)
        for r in v.targets.values() if v else ():
            peer = f"{title_of(engines, r.peer_name)}: {_spent(r.peer)}" if r.peer else "never"
            if not r.tried - {OURS, RIVAL}:
                peer = "none run"
            rival = _spent(r.mujoco) if RIVAL in r.tried else "not run"
            own = "" if r.own is None or r.own is r.ours else _spent(r.own)
            lines.append([
                case_title(cases, name), power(r.target), _spent(r.ours), own, rival, peer,
                _factor(r.factor("mujoco")) if RIVAL in r.tried else "-",
                _factor(r.factor("peer")) if r.tried - {OURS, RIVAL} else "-",
            ])  # fmt: skip
    header = ["case", "error", "presets of rbd_jax", "another variant of ours, if faster", "MuJoCo C",
              "best other engine", "MuJoCo over ours", "best other over ours"]  # fmt: skip
    return _table(header, lines)


def _fit(fit: analysis.Slope | None) -> list[str]:
    if fit is None:
        return ["-", "-"]
    order = f"{fit.slope:.2f} ({fit.used})" if fit.slope is not None else "-"
    return [order, f"{fit.floor:.1e}" if fit.floor is not None else "not reached"]


def _slopes(rows: list, cases, engines, others: bool) -> list[str]:
    """Of the presets and the other engines, or of the ``others`` of our variants."""
    lines = []
    for name in cases:
        for c in analysis.curves(rows, name):
            mine = c.engine == OURS and not c.preset
            if mine == others and (c.order or c.self_order):
                lines.append([
                    case_title(cases, name), title_of(engines, c.engine), c.variant, c.dtype, *_fit(c.order),
                    *_fit(c.self_order),
                ])  # fmt: skip
    header = [
        "case",
        "engine",
        "variant",
        "dtype",
        "order (points)",
        "floor",
        "order to own limit (points)",
        "its floor",
    ]
    return _table(header, lines)


#: A fitted order may be off by this.
NEAR = 0.2


def _orders(rows: list, cases, engines) -> list[str]:
    """Orders of ours against those they should have, to the truth or to their own limit."""
    lines, met, judged = [], 0, 0
    for name, case in cases.items():
        for c in analysis.curves(rows, name):
            wanted = engines[c.engine].order(case, c.variant) if c.engine == OURS and OURS in engines else None
            if wanted is None:
                continue
            fit = c.order or c.self_order
            if fit is None or fit.slope is None:
                seen, verdict = "-", f"at its floor, {fit.floor:.1e}" if fit and fit.floor else "too few points"
            else:
                near = abs(fit.slope - wanted) <= NEAR
                judged, met = judged + 1, met + near
                seen, verdict = f"{fit.slope:.2f} ({fit.used})", "yes" if near else "**no**"
            lines.append([case_title(cases, name), c.variant, c.dtype, wanted, seen, verdict])
    if not lines:
        return ["No curve of ours with an order to show.", ""]
    told = f'{met} of {judged} fitted orders are within {NEAR} of what they should be; the other curves have less than \
three points above their floor. None is claimed at rest, in piles, where impacts are hit at their instant, and of \
"fast" in contact, which splits coarse steps.'
    return [told, "", *_table(["case", "variant", "dtype", "should be", "order (points)", "within 0.2"], lines)]


def _failures(rows: list, cases, engines) -> list[str]:
    """Points that did not run, per case, engine and variant, with the reasons."""
    text, lost = [], collections.defaultdict(list)
    for r in rows:
        if r["status"] != "ok":
            lost[r["case"], r["engine"], r["variant"], r["dtype"], r["status"], r.get("reason", "")].append(r["dt"])
    lines = [
        [case_title(cases, c), title_of(engines, e), v, w, s, why, ", ".join(milliseconds(d) for d in sorted(dts))]
        for (c, e, v, w, s, why), dts in lost.items()
    ]
    partly = sum((analysis.value(r, "error", "failed_worlds") or 0) > 0 for r in rows if analysis.ok(r))
    if partly:
        text += [f"In {partly} points that count as run some worlds failed; the CSV files name them.", ""]
    if lines:
        text += _table(["case", "engine", "variant", "dtype", "status", "reason", "steps"], lines)
    return text or ["None.", ""]


def _absent(rows: list, cases, engines, runs) -> list[str]:
    missing = [
        [title_of(engines, r["engine"]), r["reason"], f"`{r['install']}`" if r.get("install") else ""]
        for r in analysis.notes(rows, "missing", runs)
    ]
    refused = collections.defaultdict(list)
    for r in analysis.notes(rows, "refused", runs):
        refused[r["engine"], r["variant"], r["reason"]].append(case_title(cases, r["case"]))
    lines = [[title_of(engines, e), v, ", ".join(names), why] for (e, v, why), names in refused.items()]
    text = ["Engines that were not here:", "", *_table(["engine", "why", "how to get it"], missing)] if missing else []
    if lines:
        text += ["Cases that an engine cannot express:", "", *_table(["engine", "variant", "cases", "why"], lines)]
    return text or ["No engine was missing, none refused a case.", ""]


def _history(rows: list, cases, engines, machine) -> list[str]:
    here = [r for r in rows if r.get("kind") == "point" and analysis.machine(r) == machine]
    found = analysis.changes(here)
    broken = analysis.broken(here)
    if not found and not broken:
        return ["Every point of this machine was measured at one commit so far.", ""]
    flagged = sorted((c for c in found if c.flagged), key=lambda c: -abs(math.log(max(c.ratio, 1e-12))))
    text = [
        f"{len(found)} figures were measured at two commits; {len(flagged)} changed beyond noise. (Times: the "
        f"quartiles do not overlap and the ratio is beyond {analysis.TIME_NOISE}. "
        f"Errors: beyond {analysis.ERROR_NOISE}.)",
        "",
    ]
    drift = analysis.drift(found)
    if drift:
        told = "; ".join(f"{title_of(engines, e)} {ratio:.2f} ({n})" for e, (ratio, n) in drift.items())
        text += [
            f"Geometric mean of the time ratios, after over before (number): {told}. An engine whose version did not "
            "change shows how much of it is the machine.", "",
        ]  # fmt: skip
    name = lambda k: [case_title(cases, k[0]), title_of(engines, k[1]), f"{k[2]}, {k[3]}", milliseconds(k[4])]
    if broken:
        lines = [
            [*name(k), "fails now" if status == "failed" else "runs now", " -> ".join(c)] for k, c, status in broken
        ]
        text += _table(["case", "engine", "variant", "step", "what", "commits"], lines)
    if flagged:
        lines = []
        for c in flagged[:CHANGES]:
            what = f"time, {TEXT[c.batch]}" if c.what == "time" else "error"
            show = duration if c.what == "time" else lambda v: f"{v:.2e}"
            note = "" if c.same_versions else " (other versions of libraries)"
            lines.append(
                [*name(c.key), what, show(c.before), show(c.after), f"{c.ratio:.3g}", " -> ".join(c.commits) + note]
            )
        text += _table(["case", "engine", "variant", "step", "what", "before", "after", "ratio", "commits"], lines)
        if len(flagged) > CHANGES:
            text += [f"And {len(flagged) - CHANGES} smaller ones.", ""]
    return text


def _machine(rows: list, every: list, machine) -> list[str]:
    if not rows:
        return ["No point was measured.", ""]
    newest = max(rows, key=lambda r: r.get("date", ""))
    dates = sorted(r.get("date", "") for r in rows)
    commits = collections.Counter(r["commit"] for r in rows)
    cpu, cores, platform = machine
    versions = ", ".join(f"{k} {v}" for k, v in newest.get("versions", {}).items())
    state = collections.Counter(r["status"] for r in rows)
    text = [
        f"{cpu}, {cores} cores, platform {platform}. {versions}.",
        f"{len(rows)} points ({', '.join(f'{n} {s}' for s, n in state.items())}), suite {newest.get('suite', '?')}, "
        f"{dates[0]} to {dates[-1]}, at commits {', '.join(f'{c} ({n} points)' for c, n in commits.items())}.",
    ]  # fmt: skip
    ended = {r["run"] for r in every if r.get("kind") == "end"}
    open_ = {r["run"] for r in every if r.get("kind") == "start"} - ended
    if open_ & {r["run"] for r in rows}:
        text.append("Points of runs that did not end are among them.")
    others = {analysis.machine(r) for r in every if r.get("kind") == "point"} - {machine}
    if others:
        text.append(
            "Not shown, as times of other machines do not compare: "
            + "; ".join(map(str, sorted(others, key=str)))
            + "."
        )
    return [*text, ""]


def _cases(cases, names: set[str]) -> list[str]:
    lines = [
        [c.title, c.group, ", ".join(sorted(c.features)) or "-", len(c.parts), c.unit, c.reference, f"{c.bound:.0e}"]
        for n, c in cases.items() if n in names
    ]  # fmt: skip
    return _table(["case", "group", "features", "bodies", "error is", "truth from", "truth known to"], lines)


def _engines(engines, names: set[str]) -> list[str]:
    lines = [[e.title, v, words] for n, e in engines.items() if n in names for v, words in e.variants.items()]
    return _table(["engine", "variant", "what it is"], lines)


# --- pages ---


def _sections(rows: list, every: list, cases, engines, machine, runs) -> list[tuple[str, list[str]]]:
    """(heading, Markdown lines) in order."""
    verdicts = analysis.verdicts(rows, cases)
    losses = _losses(verdicts, cases, engines)
    seen, ran = {r["case"] for r in rows}, {r["engine"] for r in rows}
    sections = [
        ("Machine and versions", _machine(rows, every, machine)),
        ("Shares", _shares(verdicts)),
        ("Where rbd_jax loses", [f"- {t}" for t in losses] + [""] if losses else ["At no case, batch and error.", ""]),
    ]
    for batch in reversed(BATCHES):
        sections.append((f"Who reaches which error first, {TEXT[batch]}", [
            "Bold: not rbd_jax. In brackets variant, dtype and step; ours: the presets.", "",
            *_winners(verdicts, cases, engines, batch),
        ]))  # fmt: skip
    for batch in reversed(BATCHES):
        sections.append((f"Time to reach an error, {TEXT[batch]}", [
            "Wall seconds per simulated second and world.", "", *_targets(verdicts, cases, engines, batch),
        ]))  # fmt: skip
    statistics = [
        case_title(cases, n) for n in cases if n in seen and not verdicts.of(n, "1") and not verdicts.of(n, "1024")
    ]
    if statistics:
        sections.append(("Cases without verdict", [f"No point with an error and a time: {', '.join(statistics)}.", ""]))
    return [
        *sections,
        ("Missing and refused", _absent(every, cases, engines, runs)),
        ("Failed and skipped points", _failures(rows, cases, engines)),
        ("Changes since the commit before", _history(every, cases, engines, machine)),
        ("How to read the charts", [READING, ""]),
        ("Orders of rbd_jax against what they should be", _orders(rows, cases, engines)),
        ("Orders and floors", _slopes(rows, cases, engines, False)),
        (PAGE_ONLY, _slopes(rows, cases, engines, True)),
        ("Cases", _cases(cases, seen)),
        ("Variants", _engines(engines, ran)),
    ]


def _markdown(sections, drawn: list[charts.Drawn], folder: pathlib.Path, corrupt: list[str]) -> str:
    relative = lambda f: f.relative_to(folder).as_posix()
    lines = ["# Speed against accuracy", ""]
    if corrupt:
        lines += [f"Rows left out, as they cannot be read or shown ({len(corrupt)}): {'; '.join(corrupt)}.", ""]
    lines += [f"![{d.title}]({relative(d.png)})\n" for d in drawn[:1]]
    for heading, body in sections:
        if heading != PAGE_ONLY:
            lines += [f"## {heading}", "", *body]
    lines += ["## Charts", "", "Each with its numbers beside it as CSV, and as SVG.", ""]
    lines += [f"- [{d.title}]({relative(d.png)}) ([numbers]({relative(d.files[2])}))" for d in drawn]
    return "\n".join(lines) + "\n"


CSS = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fdfdfd; --line: #cfcfcf; --soft: #f0f0f0; --link: #0a5a9c }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e4e4; --paper: #16181b; --line: #44484d; --soft: #23262a; --link: #7cb8ee } }
body { margin: 0 auto; padding: 1.5rem; max-width: 62rem; font: 15px/1.5 system-ui, sans-serif; color: var(--ink);
  background: var(--paper) }
h1, h2, h3 { line-height: 1.2 } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); padding-bottom: .2rem }
a { color: var(--link) } nav { columns: 3 14rem; font-size: .9rem } nav a { display: block }
.wide { overflow: auto; max-height: 34rem } table { border-collapse: collapse; font-size: .84rem }
th, td { border: 1px solid var(--line); padding: .2rem .5rem; text-align: left; vertical-align: top }
th { background: var(--soft); position: sticky; top: 0 } tr:nth-child(even) td { background: var(--soft) }
figure { margin: 1rem 0; padding: .6rem; background: #fff; border: 1px solid var(--line); border-radius: 6px }
figure img { width: 100%; height: auto; display: block }
figcaption { color: #333; font-size: .85rem; padding-top: .3rem }
.warn { border-left: 4px solid #d55e00; padding: .4rem .8rem; background: var(--soft) }
"""


def _inline(text: str) -> str:
    text = html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def _cells(line: str, tag: str) -> str:
    cells = re.split(r"(?<!\\)\|", line.strip()[1:-1])
    return "".join(f"<{tag}>{_inline(c.strip().replace(chr(92) + '|', '|'))}</{tag}>" for c in cells)


def _html_of(lines: Sequence[str]) -> str:
    """Paragraphs, lists and tables of the Markdown written here."""
    out = []
    for block in "\n".join(lines).strip().split("\n\n"):
        rows = [s for s in block.split("\n") if s]
        if not rows:
            continue
        if rows[0].startswith("|"):
            body = "".join(f"<tr>{_cells(s, 'td')}</tr>" for s in rows[2:])
            out.append(f'<div class="wide"><table><thead><tr>{_cells(rows[0], "th")}</tr></thead>{body}</table></div>')
        elif rows[0].startswith("- "):
            out.append("<ul>" + "".join(f"<li>{_inline(s[2:])}</li>" for s in rows) + "</ul>")
        else:
            out.append(f"<p>{_inline(' '.join(rows))}</p>")
    return "\n".join(out)


def _figure(title: str, png: pathlib.Path, note: str = "") -> str:
    data = base64.b64encode(pathlib.Path(png).read_bytes()).decode()
    words = html.escape(title)
    return (
        f'<figure><img alt="{words}" loading="lazy" src="data:image/png;base64,{data}">'
        f"<figcaption>{words}{html.escape(note)}</figcaption></figure>"
    )


def _page(sections, drawn: list[charts.Drawn], extra, corrupt: list[str], cases) -> str:
    shown = lambda d: _figure(d.title, d.png, f" (numbers: {d.files[2].name})")
    general = [d for d in drawn if not d.case]
    parts, listed = [], []

    def add(heading: str, body: str):
        place = f"s{len(listed)}"
        listed.append(f'<a href="#{place}">{html.escape(heading)}</a>')
        parts.append(f'<section id="{place}"><h2>{html.escape(heading)}</h2>\n{body}</section>')

    add("Overview", "".join(map(shown, general[:1])))
    words = dict(sections)
    first = ("Machine and versions", "Shares", "Where rbd_jax loses")
    for heading in first:
        add(heading, _html_of(words[heading]))
    add("How to read the charts", _html_of(words["How to read the charts"]))
    add("All cases side by side", "".join(map(shown, general[1:])))
    for name in dict.fromkeys(d.case for d in drawn if d.case):
        c = cases[name]
        told = f"<p>Error: {html.escape(c.unit)}. Truth: {html.escape(c.reference)}, known to {c.bound:.0e}.</p>"
        add(c.title, told + "".join(shown(d) for d in drawn if d.case == name))
    if extra:
        add("Stability and gradients", "".join(_figure(title, png) for title, png in extra))
    for heading, body in sections:
        if heading not in (*first, "How to read the charts"):
            add(heading, _html_of(body))
    warning = ""
    if corrupt:
        items = "".join(f"<li>{html.escape(c)}</li>" for c in corrupt)
        warning = f'<div class="warn">Rows left out, as they cannot be read or shown: <ul>{items}</ul></div>'
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>rbd_jax: speed against accuracy</title>'
        f'<meta name="viewport" content="width=device-width"><style>{CSS}</style></head><body>'
        f"<h1>rbd_jax: speed against accuracy</h1>{warning}<nav>{''.join(listed)}</nav>\n"
        f"{''.join(parts)}</body></html>\n"
    )


def write(
    rows: Sequence[dict],
    cases: dict[str, Any],
    engines: dict[str, Any],
    folder,
    extra: Sequence[tuple[str, Any]] = (),
    corrupt: Sequence[str] = (),
    runs: Sequence[str] | None = None,
    machine: tuple | None = None,
) -> list[pathlib.Path]:
    """Write ``suite.html``, ``suite.md`` and the charts under ``suite/``; returns all files.

    Args:
      rows: of all kinds and runs; the history is read from them.
      extra: (title, PNG) of charts made elsewhere; those that are not there are left out.
      corrupt: what could not be read, in words; named in both pages.
      runs: ids whose points are shown (default: the newest point of every key).
      machine: (cpu, cores, platform) that is shown (default: that of the newest point).
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows, corrupt = list(rows), list(corrupt)
    if machine is None:
        chosen = [r for r in rows if runs is None or r.get("run") in set(runs)]
        machine = analysis.newest_machine(chosen)
    points = [r for r in analysis.latest(rows, runs, machine) if r["case"] in cases]
    gone = sorted({r["case"] for r in rows if r.get("kind") == "point"} - set(cases))
    if gone:
        corrupt.append(f"cases that are no longer defined: {', '.join(gone)}")
    drawn = charts.draw(points, cases, engines, folder / "suite")
    sections = _sections(points, rows, cases, engines, machine, runs)
    extra = [(title, pathlib.Path(png)) for title, png in extra if pathlib.Path(png).is_file()]
    pages = [folder / "suite.html", folder / "suite.md"]
    pages[0].write_text(_page(sections, drawn, extra, corrupt, cases), encoding="utf-8")
    pages[1].write_text(_markdown(sections, drawn, folder, corrupt), encoding="utf-8")
    return [*pages, *(f for d in drawn for f in d.files)]
