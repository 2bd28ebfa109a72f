"""Imports point downward only, and the hot path keeps its rules."""

import ast
import pathlib

import rbd_jax

ROOT = pathlib.Path(rbd_jax.__file__).parent
LAYER = {
    "checks": 0,
    "struct": 0,
    "status": 0,
    "spatial": 1,
    "xla": 1,
    "loops": 1,
    "implicit": 1,
    "kernel": 2,
    "bodies": 2,
    "shapes": 2,
    "scene": 3,
    "state": 3,
    "mjcf": 4,
    "integrators": 4,
    "contact": 4,
    "solvers": 5,
    "method": 6,
    "model": 6,
    "detect": 7,
    "events": 7,
    "step": 7,
    "build": 7,
    "tiles": 8,
    "spread": 8,
    "memory": 8,
    "estimate": 8,
    "processes": 8,
    "rollout": 8,
    "diagnostics": 8,
    "audit": 8,
    "convert": 8,
    "horizon": 8,
    "parity": 9,
    "farm": 9,
    "learn": 9,
    "longrun": 9,
    "record": 9,
    "suite": 9,
    "view": 9,
    "cli": 10,
    "examples": 3,
}
#: Inside one layer: who may import whom.
WITHIN = {
    ("loops", "xla"),
    ("model", "method"),
    ("step", "detect"),
    ("step", "events"),
    ("events", "detect"),
    ("build", "step"),
    ("spread", "tiles"),
    ("processes", "tiles"),
    ("rollout", "spread"),
    ("rollout", "tiles"),
    ("rollout", "memory"),
    ("estimate", "rollout"),
    ("estimate", "memory"),
    ("record", "view"),
    ("mjcf", "examples"),
    ("diagnostics", "rollout"),
    ("horizon", "rollout"),
    ("audit", "rollout"),
    ("audit", "diagnostics"),
    ("parity", "record"),
    ("longrun", "record"),
    ("learn", "record"),
    ("learn", "view"),
}


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if name not in ("__init__", "__main__"):
            yield name, path


def targets(name, path):
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            full = (*base, *(node.module or "").split(".")) if node.module else base
            names = [full[0]] if full and full[0] else [a.name for a in node.names]
            yield from ((node.lineno, n) for n in names)


def test_imports_point_downward():
    wrong = []
    for name, path in modules():
        for line, target in targets(name, path):
            if target == name or target not in LAYER:
                continue
            if LAYER[target] > LAYER[name] or (LAYER[target] == LAYER[name] and (name, target) not in WITHIN):
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {target} (layer {LAYER[target]})")
    assert not wrong, "\n".join(wrong)


def test_every_module_has_a_layer():
    missing = {name for name, _ in modules()} - set(LAYER)
    assert not missing
