"""A flat program as one function of C: what a GPU's thread does for one world.

Every value is a variable, or an array in the thread's own memory. Operations on arrays of one length are put off until
a result of theirs is needed elsewhere, and then become one loop, in which what nothing else needs is a variable. Slices
and the like are only other ways to find an element. An array is changed in place where nothing reads its old content
any more.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np

from .flat import LOOPS, Constant, Flat, Op, Unsupported, Var, closed_and_carried, whole
from .operations import PRELUDE, expression, literal, type_of

#: Loops over no more elements are written out by the compiler, so that their arrays can live in registers.
UNROLLED = 16
#: Bytes of arrays in a thread's own memory: all threads that a GPU can hold get so much at once, 17 GB of an H100. With
#: more they are in a buffer for the threads that are started.
LOCAL = 64 * 1024
#: Bytes of arrays of a thread at most.
MEMORY = 1024 * 1024

_REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_or": "or", "reduce_and": "and",
               "reduce_prod": "mul"}  # fmt: skip
_SCATTERS = {"scatter": None, "scatter-add": "add", "scatter-mul": "mul", "scatter-min": "min", "scatter-max": "max"}
_VIEWS = frozenset("broadcast_in_dim transpose slice rev".split())


@dataclasses.dataclass(eq=False)
class Array:
    """Where a value is: ``at(k)`` is its element k (a number or an expression) in C.

    name: of memory of this program, made at this depth of loops, which may be changed there. root: the array whose
    memory it shares. place: (pool, first element) of memory that is given back when nothing reads it any more.
    """

    at: Callable[[str], str]
    size: int
    name: str | None = None
    depth: int = -1
    root: Array | None = None
    place: tuple[Pool, int] | None = None


class Pool:
    """Memory of one type, of which arrays take parts and give them back."""

    def __init__(self, dtype, name: str):
        self.dtype, self.name, self.size = np.dtype(dtype), name, 0
        self.free: list[tuple[int, int]] = []  # (first, elements), in order

    def take(self, size: int) -> int:
        for j, (first, room) in enumerate(self.free):
            if room >= size:
                self.free[j : j + 1] = [(first + size, room - size)] if room > size else []
                return first
        if self.free and sum(self.free[-1]) == self.size:
            first, _ = self.free.pop()
        else:
            first = self.size
        self.size = first + size
        return first

    def give(self, first: int, size: int) -> None:
        merged: list[tuple[int, int]] = []
        for begin, room in sorted([*self.free, (first, size)]):
            if merged and sum(merged[-1]) == begin:
                merged[-1] = (merged[-1][0], merged[-1][1] + room)
            else:
                merged.append((begin, room))
        self.free = merged


class Emitter:
    """Writes the C of one program."""

    def __init__(self):
        self.lines: list[str] = []
        self.tables: dict[bytes, str] = {}
        self.table_lines: list[str] = []
        self.count = itertools.count()
        self.depth = 0
        self.pools: dict[str, Pool] = {}

    def name(self) -> str:
        return f"v{next(self.count)}"

    def line(self, text: str) -> None:
        self.lines.append("  " * (self.depth + 1) + text)

    def declare(self, dtype, size: int) -> Array:
        """An array (a variable if of one element) of the present depth."""
        name, kind = self.name(), type_of(dtype)
        if size == 1:
            self.line(f"{kind} {name};")
            return Array(lambda k: name, 1, name, self.depth)
        if size > UNROLLED:
            pool = self.pools.setdefault(np.dtype(dtype).name, Pool(dtype, f"pool{len(self.pools)}"))
            first = pool.take(size)
            at = lambda k: f"{pool.name}[AT({_plus(first, k)})]"
            return Array(at, size, name, self.depth, place=(pool, first))
        self.line(f"{kind} {name}[{size}];")
        return Array(lambda k: f"{name}[{k}]", size, name, self.depth)

    def release(self, array: Array) -> None:
        pool, first = array.place
        pool.give(first, array.size)

    @property
    def memory(self) -> int:
        """Bytes of the pools."""
        return sum(pool.size * pool.dtype.itemsize for pool in self.pools.values())

    def loop(self, size: int, body: Callable[[str], None], unroll: bool | None = None) -> None:
        """``body(index)`` for every index below ``size``."""
        if size == 1:
            self.line("{")
            self.depth += 1
            body("0")
        else:
            k = self.name()
            many = size > UNROLLED if unroll is None else not unroll
            self.line(f"#pragma unroll{' 1' if many else ''}")
            self.line(f"for (int {k} = 0; {k} < {size}; ++{k}) {{")
            self.depth += 1
            body(k)
        self.depth -= 1
        self.line("}")

    def constant(self, value: np.ndarray) -> Array:
        flat = np.ravel(value)
        if flat.size and (flat == flat[0]).all():
            text = literal(flat[0])
            return Array(lambda k: text, flat.size)
        key = flat.dtype.name.encode() + flat.tobytes()
        if key not in self.tables:
            self.tables[key] = name = f"table{len(self.tables)}"
            numbers = ", ".join(literal(x) for x in flat)
            self.table_lines.append(f"TABLE {type_of(flat.dtype)} {name}[{flat.size}] = {{{numbers}}};")
        name = self.tables[key]

        def at(k):
            known = _number(k)
            return f"{name}[{k}]" if known is None else literal(flat[known])

        return Array(at, flat.size)


def _number(k) -> int | None:
    try:
        return int(k)
    except ValueError:
        return None


def _plus(*terms) -> str:
    """A sum of numbers and expressions."""
    known = [_number(t) for t in terms]
    rest = [f"{t}" for t, n in zip(terms, known) if n is None]
    total = sum(n for n in known if n is not None)
    parts = rest + ([str(total)] if total or not rest else [])
    return parts[0] if len(parts) == 1 else "(" + " + ".join(parts) + ")"


def _times(k, n: int) -> str:
    known = _number(k)
    return str(known * n) if known is not None else str(k) if n == 1 else "0" if n == 0 else f"{k} * {n}"


def _digits(k, shape) -> list[str]:
    """The indices of flat index k in an array of this shape."""
    known, out, size = _number(k), [], int(np.prod(shape, dtype=np.int64))
    for j, n in enumerate(shape):
        size //= max(n, 1)
        if n == 1:
            out.append("0")
        elif known is not None:
            out.append(str(known // size % n))
        else:
            text = str(k) if size == 1 else f"({k} / {size})"
            first = all(m == 1 for m in shape[:j])
            out.append(text if first else f"({text} % {n})")
    return out


def _flat(digits, shape) -> str:
    """The flat index of indices."""
    strides = np.cumprod([1, *shape[:0:-1]])[::-1] if shape else []
    return _plus(*(_times(d, int(n)) for d, n in zip(digits, strides))) if shape else "0"


def _in_step(op: Op) -> bool:
    """Whether a gather takes one element for each index, in their order."""
    d, (_, index), (out,) = op.params["dimension_numbers"], op.ins, op.outs
    return len(d.start_index_map) == 1 and index.size == out.size and not d.operand_batching_dims


class Scope:
    """The operations of one body: its values, and what is put off."""

    def __init__(self, emitter: Emitter, program: Flat, values: list[Array]):
        self.e, self.program = emitter, program
        self.env: dict[Var, Array] = dict(zip(program.ins, values, strict=True))
        self.given = {a.name for a in values}
        self.waiting: dict[int, list[int]] = {}  # length of the arrays -> operations that are put off
        self.waits: dict[Var, int] = {}
        self.users: dict[Var, set[int]] = {}
        for i, op in enumerate(program.ops):
            for v in op.ins:
                if isinstance(whole(v), Var):
                    self.users.setdefault(whole(v), set()).add(i)
        for v in program.outs:
            if isinstance(whole(v), Var):
                self.users.setdefault(whole(v), set()).add(len(program.ops))
        self.passing = {i for i, op in enumerate(program.ops) if self._passes(op)}
        self.root, self.last = self._last()
        self.held: dict[str, tuple[Array, Var]] = {}  # memory of the pools and the last variable that lives there

    def _hold(self, var: Var, array: Array) -> Array:
        """``array`` is where ``var`` is from now on."""
        if array.place is not None and array.name not in self.given:
            self.held[array.name] = (array, var)
        self.env[var] = array
        return array

    def _give_back(self, i: int) -> None:
        """Free what nothing reads behind operation i."""
        if not self.held:
            return
        ops = self.program.ops
        read = {
            self.root.get(v, v)
            for group in self.waiting.values() for j in group for v in map(whole, ops[j].ins) if isinstance(v, Var)
        }  # fmt: skip
        for name, (array, var) in list(self.held.items()):
            if self.last.get(var, -1) <= i and var not in read:
                self.e.release(array)
                del self.held[name]

    def close(self) -> None:
        """Free all that is left, when the results have been read."""
        for array, _ in self.held.values():
            self.e.release(array)

    def _passes(self, op: Op) -> bool:
        """Whether an operation only says where elements are."""
        if op.name in _VIEWS:
            return True
        if op.name != "dynamic_slice" or op.outs[0].size == 1:
            return False
        users, ops = self.users.get(op.outs[0], set()), self.program.ops
        # who computes with a slice more than once should have it at hand
        return all(i < len(ops) and ops[i].name in (*_VIEWS, "dynamic_slice") for i in users)

    def _last(self) -> tuple[dict[Var, Var], dict[Var, int]]:
        """Whose memory a view reads, and the last operation that reads that of a variable, through whatever view."""
        root: dict[Var, Var] = {}
        for i, op in enumerate(self.program.ops):
            if i in self.passing and op.outs[0].size > 1 and isinstance(whole(op.ins[0]), Var):
                root[op.outs[0]] = root.get(whole(op.ins[0]), whole(op.ins[0]))
        last: dict[Var, int] = {}
        for v, users in self.users.items():
            r = root.get(v, v)
            last[r] = max(last.get(r, -1), *users)
        return root, {**last, **{v: last.get(r, -1) for v, r in root.items()}}

    # --- reading ---

    def value(self, v) -> Array:
        v = whole(v)
        if isinstance(v, Constant):
            return self.e.constant(v.array)
        if v in self.waits:
            self.flush(self.waits[v])
        return self.env[v]

    def flush(self, size: int | None = None) -> None:
        """Write the loop of the operations on arrays of this length that were put off (None: of every length)."""
        for n in list(self.waiting) if size is None else [size]:
            self._write(n, self.waiting.pop(n))

    def _write(self, size: int, group: list[int]) -> None:
        ops, members = self.program.ops, set(group)
        kept = {}
        for i in group:
            (out,) = ops[i].outs
            del self.waits[out]
            if self.users.get(out, set()) - members:
                kept[out] = self._hold(out, self.e.declare(out.dtype, size))
        inside: dict[Var, str] = {}

        def body(k):
            for i in group:
                (out,) = ops[i].outs
                text = self._element(ops[i], k, inside)
                name = inside[out] = self.e.name()
                self.e.line(f"const {type_of(out.dtype)} {name} = {text};")
                if out in kept:
                    self.e.line(f"{kept[out].at(k)} = {name};")

        self.e.loop(size, body)

    def _element(self, op: Op, k, inside) -> str:
        (out,) = op.outs

        def read(v):
            shape, v = tuple(v.shape), whole(v)
            if v.size in (1, out.size):
                return inside[v] if v in inside else self.value(v).at("0" if v.size == 1 else k)
            stretched = [d if n > 1 else "0" for d, n in zip(_digits(k, out.shape), shape)]
            return self.value(v).at(_flat(stretched, shape))

        if op.name == "gather":
            return self._gathered(op, k, read)
        if op.name == "iota":
            digit = _digits(k, op.outs[0].shape)[op.params["dimension"]]
            return f"({type_of(op.outs[0].dtype)})({digit})"
        if op.name == "dynamic_slice":
            return self._sliced(op, k)
        text = expression(
            op.name, [read(v) for v in op.ins], [v.dtype for v in op.ins], op.outs[0].dtype, op.params
        )  # fmt: skip
        if text is None:
            raise Unsupported(f"operation '{op.name}'")
        return text

    # --- operations ---

    def run(self) -> list[Array]:
        for i, op in enumerate(self.program.ops):
            self._do(i, op)
            self._give_back(i)
        self.flush()
        return [self.value(v) for v in self.program.outs]

    def _do(self, i: int, op: Op) -> None:
        if any(out.size == 0 for out in op.outs) and op.name not in LOOPS:
            for out in op.outs:
                self.env[out] = Array(lambda k: "0", 0)
        elif op.name == "unset":
            self._hold(op.outs[0], self.e.declare(op.outs[0].dtype, op.outs[0].size))
        elif i in self.passing:
            self.env[op.outs[0]] = self._view(op)
        elif op.name in _REDUCTIONS:
            self._reduce(op)
        elif op.name in ("concatenate", "pad", "split", "stack"):
            getattr(self, "_" + op.name)(op)
        elif op.name == "dynamic_update_slice":
            self._update(i, op)
        elif op.name in _SCATTERS:
            self._scatter(i, op)
        elif op.name in LOOPS:
            self.flush()
            getattr(self, "_" + op.name)(i, op)
        else:
            self._elementwise(i, op)

    def _elementwise(self, i: int, op: Op) -> None:
        (out,) = op.outs
        for v in op.ins:
            v = whole(v)
            # an element at the same place is read in the loop itself
            elsewhere = (
                op.name == "dynamic_slice" or op.name == "gather" and (v is whole(op.ins[0]) or not _in_step(op))
            )
            if isinstance(v, Var) and v in self.waits and (self.waits[v] != out.size or elsewhere):
                self.flush(self.waits[v])
        if out.size == 1:
            self.env[out] = self._read(out, self._element(op, "0", {}))
            return
        self.waiting.setdefault(out.size, []).append(i)
        self.waits[out] = out.size

    def _view(self, op: Op) -> Array:
        source, (out,) = op.ins[0], op.outs
        base = self.value(source)
        shape, p = tuple(source.shape), op.params
        starts = []
        if op.name == "dynamic_slice":
            starts = [self._start(v, n - m) for v, n, m in zip(op.ins[1:], shape, out.shape)]

        def digits(k):
            d = _digits(k, out.shape)
            if starts:
                return [_plus(x, a) for x, a in zip(d, starts)]
            if op.name == "broadcast_in_dim":
                return [d[j] if n > 1 else "0" for n, j in zip(shape, p["broadcast_dimensions"])]
            if op.name == "transpose":
                where = {j: d[i] for i, j in enumerate(p["permutation"])}
                return [where[j] for j in range(len(shape))]
            if op.name == "slice":
                strides = p["strides"] or [1] * len(shape)
                return [_plus(_times(x, int(s)), int(a)) for x, s, a in zip(d, strides, p["start_indices"])]
            return [f"({n - 1} - {x})" if j in p["dimensions"] else x for j, (x, n) in enumerate(zip(d, shape))]

        if out.size == 1:
            return self._read(out, base.at(_flat(digits("0"), shape)))
        if source.size == 1:
            return Array(lambda k: base.at("0"), out.size)
        return Array(lambda k: base.at(_flat(digits(k), shape)), out.size, root=base.root or base)

    def _read(self, out: Var, text: str) -> Array:
        name = self.e.name()
        self.e.line(f"const {type_of(out.dtype)} {name} = {text};")
        return Array(lambda k: name, 1)

    def _sliced(self, op: Op, k) -> str:
        source, starts = op.ins[0], op.ins[1:]
        digits = []
        for d, start, n, m in zip(_digits(k, op.outs[0].shape), starts, source.shape, op.outs[0].shape):
            digits.append(_plus(d, self._start(start, n - m)))
        return self.value(source).at(_flat(digits, source.shape))

    def _start(self, start, last: int) -> str:
        """Where a slice begins along one axis."""
        if last == 0:
            return "0"
        text = self.value(start).at("0")
        known = _number(text)
        if known is not None:
            return str(min(max(known, 0), last))
        name = self.e.name()  # what the text names may change before it is used
        self.e.line(f"const int {name} = inside({text}, {last});")
        return name

    def _update(self, i: int, op: Op) -> None:
        old, new, *starts = op.ins
        (out,) = op.outs
        self.flush()
        source, values = self.value(old), self.value(new)
        where = [self._start(s, n - m) for s, n, m in zip(starts, old.shape, new.shape)]
        if out.size == 1:
            self.env[out] = self._read(out, values.at("0"))
            return
        target = self._owned(i, old, source, op)
        self._hold(out, target)
        self._put(target, old.shape, values, new.shape, lambda d: [_plus(x, s) for x, s in zip(d, where)])

    def _put(self, target: Array, shape, part: Array, of, place) -> None:
        """Copy ``part`` of shape ``of`` into ``target``: its element of indices d to that of indices place(d)."""

        def one(k):
            self.e.line(f"{target.at(_flat(place(_digits(k, of)), shape))} = {part.at(k)};")

        if part.size:
            self.e.loop(part.size, one)

    def _owned(self, i: int, v, source: Array, op: Op) -> Array:
        """The memory of ``v`` if it may be changed at operation i, else a copy."""
        var = whole(v)
        free = isinstance(var, Var) and self.last.get(var, -1) <= i and sum(whole(x) is var for x in op.ins) == 1
        if free and source.name and source.depth == self.e.depth and source.root is None:
            return source
        copy = self.e.declare(v.dtype, source.size)
        self._copy(copy, source)
        return copy

    def _copy(self, target: Array, source: Array) -> None:
        if target.size == 1:
            self.e.line(f"{target.at('0')} = {source.at('0')};")
        else:
            self.e.loop(target.size, lambda k: self.e.line(f"{target.at(k)} = {source.at(k)};"))

    def _gathered(self, op: Op, k, read) -> str:
        source, index = op.ins
        d, sizes = op.params["dimension_numbers"], op.params["slice_sizes"]
        out = _digits(k, op.outs[0].shape)
        offset = [out[j] for j in d.offset_dims]
        batch = [x for j, x in enumerate(out) if j not in d.offset_dims]
        gone = {*d.collapsed_slice_dims, *d.operand_batching_dims}
        digits, rest = [], iter(offset)
        where = Array(lambda _: read(index), index.size) if _in_step(op) else self.value(index)
        inner = index.shape[:-1]
        for axis, n in enumerate(source.shape):
            terms = [] if axis in gone else [next(rest)]
            if axis in d.operand_batching_dims:
                terms.append(batch[d.start_indices_batching_dims[d.operand_batching_dims.index(axis)]])
            if axis in d.start_index_map:
                at = _flat([*batch, str(d.start_index_map.index(axis))], index.shape) if inner else "0"
                start, last = where.at(at), n - sizes[axis]
                known = _number(start)
                terms.append(str(min(max(known, 0), last)) if known is not None else f"inside({start}, {last})")
            digits.append(_plus(*terms) if terms else "0")
        text = self.value(source).at(_flat(digits, source.shape))
        if "FILL" in str(op.params["mode"]):
            checks = []
            for j, axis in enumerate(d.start_index_map):
                start = where.at(_flat([*batch, str(j)], index.shape))
                known, last = _number(start), source.shape[axis] - sizes[axis]
                if known is None:
                    checks.append(f"(unsigned)({start}) <= {last}u")
                elif not 0 <= known <= last:
                    checks.append("false")
            fill = op.params["fill_value"]
            if fill is None:
                fill = np.nan if np.dtype(op.outs[0].dtype).kind == "f" else np.iinfo(op.outs[0].dtype).min \
                    if np.dtype(op.outs[0].dtype).kind == "i" else np.iinfo(op.outs[0].dtype).max \
                    if np.dtype(op.outs[0].dtype).kind == "u" else True  # fmt: skip
            if checks:
                text = f"({' && '.join(checks)} ? {text} : {literal(np.asarray(fill, op.outs[0].dtype))})"
        return text

    def _scatter(self, i: int, op: Op) -> None:
        old, index, new = op.ins
        d, join = op.params["dimension_numbers"], _SCATTERS[op.name]
        self.flush()
        where, values = self.value(index), self.value(new)
        target = self._owned(i, old, self.value(old), op)
        self._hold(op.outs[0], target)
        gone = sorted({*d.inserted_window_dims, *d.operand_batching_dims})
        window = [new.shape[j] for j in d.update_window_dims]
        sizes = dict(zip([j for j in range(len(old.shape)) if j not in gone], window)) | dict.fromkeys(gone, 1)

        def put(k):
            digits = _digits(k, new.shape)
            batch = [x for j, x in enumerate(digits) if j not in d.update_window_dims]
            rest = iter([digits[j] for j in d.update_window_dims])
            at, fits = [], []
            for axis, n in enumerate(old.shape):
                terms = [] if axis in gone else [next(rest)]
                if axis in d.operand_batching_dims:
                    terms.append(batch[d.scatter_indices_batching_dims[d.operand_batching_dims.index(axis)]])
                if axis in d.scatter_dims_to_operand_dims:
                    column = str(d.scatter_dims_to_operand_dims.index(axis))
                    start, last = where.at(_flat([*batch, column], index.shape)), n - sizes[axis]
                    if "CLIP" in str(op.params["mode"]):
                        start = f"inside({start}, {last})"
                    elif "PROMISE" not in str(op.params["mode"]):
                        fits.append(f"(unsigned)({start}) <= {last}u")
                    terms.append(start)
                at.append(_plus(*terms) if terms else "0")
            place, kind = target.at(_flat(at, old.shape)), old.dtype
            text = values.at(k) if join is None else expression(join, [place, values.at(k)], [kind, kind], kind, {})
            self.e.line((f"if ({' && '.join(fits)}) " if fits else "") + f"{place} = {text};")

        self.e.loop(new.size, put)

    def _reduce(self, op: Op) -> None:
        source, (out,) = op.ins[0], op.outs
        base, axes, shape = self.value(source), op.params["axes"], tuple(source.shape)
        kind, join = np.dtype(out.dtype), _REDUCTIONS[op.name]
        first = {"add": 0, "mul": 1, "or": 0, "and": True if kind.kind == "b" else -1}.get(join)
        target = self._hold(out, self.e.declare(out.dtype, out.size))
        inner = [shape[a] for a in axes]
        count = int(np.prod(inner, dtype=np.int64))

        def over(k):
            kept = iter(_digits(k, out.shape))
            fixed = {j: next(kept) for j in range(len(shape)) if j not in axes}

            def at(r):
                turning = dict(zip(axes, _digits(r, inner)))
                return base.at(_flat([fixed[j] if j in fixed else turning[j] for j in range(len(shape))], shape))

            total = self.e.name()
            begin = at("0") if first is None else literal(np.asarray(first, kind))
            self.e.line(f"{type_of(kind)} {total} = {begin};")
            step = lambda r: self.e.line(f"{total} = {expression(join, [total, at(r)], [kind, kind], kind, {})};")
            self.e.loop(count, step)
            self.e.line(f"{target.at(k)} = {total};")

        self.e.loop(out.size, over)

    def _concatenate(self, op: Op) -> None:
        axis = op.params["dimension"]
        starts = itertools.accumulate((v.shape[axis] for v in op.ins), initial=0)
        self._join(op, [lambda d, s=s: [*d[:axis], _plus(d[axis], s), *d[axis + 1 :]] for s in starts])

    def _stack(self, op: Op) -> None:
        axis = op.params["axis"]
        self._join(op, [lambda d, j=j: [*d[:axis], str(j), *d[axis:]] for j in range(len(op.ins))])

    def _join(self, op: Op, places) -> None:
        """A new array of all operands, each with its ``place``, see ``_put``."""
        (out,) = op.outs
        parts = [self.value(v) for v in op.ins]
        target = self._hold(out, self.e.declare(out.dtype, out.size))
        for v, part, place in zip(op.ins, parts, places):
            self._put(target, out.shape, part, v.shape, place)

    def _pad(self, op: Op) -> None:
        source, filler = op.ins
        (out,) = op.outs
        config = op.params["padding_config"]
        if any(low < 0 or high < 0 or gap for low, high, gap in config):
            raise Unsupported("negative or inner padding")
        base, fill = self.value(source), self.value(filler)
        target = self._hold(out, self.e.declare(out.dtype, out.size))
        self.e.loop(out.size, lambda k: self.e.line(f"{target.at(k)} = {fill.at('0')};"))
        self._put(target, out.shape, base, source.shape, lambda d: [_plus(x, c[0]) for x, c in zip(d, config)])

    def _split(self, op: Op) -> None:
        source, axis, start = op.ins[0], op.params["axis"], 0
        base = self.value(source)
        for out in op.outs:
            copy = self._hold(out, self.e.declare(out.dtype, out.size))

            def put(k, out=out, copy=copy, start=start):
                d = _digits(k, out.shape)
                d[axis] = _plus(d[axis], start)
                self.e.line(f"{copy.at(k)} = {base.at(_flat(d, source.shape))};")

            self.e.loop(out.size, put)
            start += out.shape[axis]

    # --- loops ---

    def _carry(self, i: int, op: Op, given) -> list[Array]:
        """Memory of what a loop carries, filled with where it starts."""
        out = []
        for v in given:
            source = self.value(v)
            if v.size > 1:
                out.append(self._owned(i, v, source, op))
                continue
            copy = self.e.declare(v.dtype, v.size)
            self._copy(copy, source)
            out.append(copy)
        return out

    def _assign(self, carry: list[Array], new: list[Array], dtypes) -> None:
        """The carry of the next round. What is only renamed among its parts goes through a copy."""
        ready = []
        names = {c.name: j for j, c in enumerate(carry)}
        for j, (c, n) in enumerate(zip(carry, new)):
            root = n.root or n
            if n is c or (n.name == c.name and n.name is not None):
                ready.append(None)
            elif root.name in names or c.size == 1:
                copy = self.e.declare(dtypes[j], c.size)
                self._copy(copy, n)
                ready.append(copy)
            else:
                ready.append(n)
        for c, n, given in zip(carry, ready, new):
            if n is not None:
                self._copy(c, n)
                if n is not given and n.place is not None:
                    self.e.release(n)

    def _inner(self, arrays: list[Array]) -> list[Array]:
        """Carried memory as the body of the loop sees it: its own."""
        return [dataclasses.replace(a, depth=self.e.depth) for a in arrays]

    def _while(self, i: int, op: Op) -> None:
        p, (test, body) = op.params, op.bodies
        first, second = p["cond_nconsts"], p["body_nconsts"]
        closed = [self.value(v) for v in op.ins[: first + second]]
        given = op.ins[first + second :]
        carry = self._carry(i, op, given)
        self.e.line("#pragma unroll 1")
        self.e.line("while (true) {")
        self.e.depth += 1
        mine = self._inner(carry)
        seen = [dataclasses.replace(a, depth=-1) for a in carry]
        tested = Scope(self.e, test, closed[:first] + seen)
        (go,) = tested.run()
        self.e.line(f"if (!{go.at('0')}) break;")
        tested.close()
        inner = Scope(self.e, body, closed[first:] + mine)
        self._assign(mine, inner.run(), [v.dtype for v in given])
        inner.close()
        self.e.depth -= 1
        self.e.line("}")
        for v, c in zip(op.outs, carry):
            self._hold(v, c)

    def _scan(self, i: int, op: Op) -> None:
        p, (body,) = op.params, op.bodies
        first, kept = closed_and_carried(p, len(op.ins))
        length = p["length"]
        closed, given = [self.value(v) for v in op.ins[:first]], op.ins[first : first + kept]
        series = [(v, self.value(v)) for v in op.ins[first + kept :]]
        carry = self._carry(i, op, given)
        stacked = [self.e.declare(v.dtype, v.size) for v in op.outs[kept:]]
        t = self.e.name()
        self.e.line("#pragma unroll 1")
        self.e.line(f"for (int {t} = 0; {t} < {length}; ++{t}) {{")
        self.e.depth += 1
        row = f"({length - 1} - {t})" if p["reverse"] else t
        mine = self._inner(carry)

        def part(v, base):
            n = v.size // length
            return Array(lambda k: base.at(_plus(_times(row, n), k)), n, root=base.root or base)

        inner = Scope(self.e, body, closed + mine + [part(*s) for s in series])
        new = inner.run()
        for v, target, value in zip(op.outs[kept:], stacked, new[kept:]):
            n = v.size // length
            put = lambda k: self.e.line(f"{target.at(_plus(_times(row, n), k))} = {value.at(k)};")
            self.e.loop(n, put)
        self._assign(mine, new[:kept], [v.dtype for v in given])
        inner.close()
        self.e.depth -= 1
        self.e.line("}")
        for v, c in zip(op.outs, carry + stacked):
            self._hold(v, c)

    def _cond(self, i: int, op: Op) -> None:
        which, given = self.value(op.ins[0]), [self.value(v) for v in op.ins[1:]]
        targets = [self.e.declare(v.dtype, v.size) for v in op.outs]
        last = len(op.bodies) - 1
        for j, body in enumerate(op.bodies):
            at = which.at("0")
            test = f"if ({at} <= 0)" if j == 0 else "else" if j == last else f"else if ({at} == {j})"
            self.e.line((test if last else "") + " {")
            self.e.depth += 1
            inner = Scope(self.e, body, given)
            for target, value in zip(targets, inner.run()):
                self._copy(target, value)
            inner.close()
            self.e.depth -= 1
            self.e.line("}")
        for v, c in zip(op.outs, targets):
            self._hold(v, c)


@dataclasses.dataclass(frozen=True)
class Leaf:
    """An argument or result: its elements of one world, dtype, and whether every world has its own."""

    size: int
    dtype: str
    own: bool


@dataclasses.dataclass(frozen=True)
class Source:
    """The text of a kernel, and the pools (dtype, elements) of a thread that it takes as its last results."""

    text: str
    pools: tuple[tuple[str, int], ...]


def source(program: Flat, arguments: list[Leaf], results: list[Leaf], name: str) -> Source:
    """A function of C, ``name(worlds, arguments..., results..., pools...)``, all pointers, element by world.

    Raises:
      Unsupported: an operation has no place in it, or a thread would need too much memory.
    """
    e = Emitter()
    values = []
    for j, (leaf, var) in enumerate(zip(arguments, program.ins, strict=True)):
        given = Array(_element_of(leaf, f"a{j}"), leaf.size)
        if leaf.size == 1:
            text = e.name()
            e.line(f"const {type_of(var.dtype)} {text} = {given.at('0')};")
            given = Array(lambda k, text=text: text, 1)
        values.append(given)
    for j, (leaf, value) in enumerate(zip(results, Scope(e, program, values).run(), strict=True)):
        put = _element_of(leaf, f"r{j}")
        e.loop(leaf.size, lambda k: e.line(f"{put(k)} = {value.at(k)};"), unroll=False)
    if e.memory > MEMORY:
        raise Unsupported(f"{e.memory} bytes of arrays for a thread, of which it may have {MEMORY}")
    pools = list(e.pools.values())
    own = e.memory <= LOCAL
    kinds = ["const int*", *(f"const {type_of(c.dtype)}*" for c in arguments)]
    kinds += [f"{type_of(c.dtype)}*" for c in results]
    names = ["batch", *(f"a{j}" for j in range(len(arguments))), *(f"r{j}" for j in range(len(results)))]
    if not own:
        kinds += [f"{type_of(pool.dtype)}*" for pool in pools]
        names += [pool.name for pool in pools]
    pointers = ", ".join(f"{kind} __restrict__ {name}" for kind, name in zip(kinds, names))
    unpacked = ", ".join(f"({kind})p[{j}]" for j, kind in enumerate(kinds))
    local = [f"  {type_of(pool.dtype)} {pool.name}[{pool.size}];" for pool in pools] if own else []
    text = f"""
#define AT(k) {"(k)" if own else "((size_t)(k) * threads + thread)"}
#ifdef __CUDACC_RTC__
extern "C" __global__ void {name}({pointers}) {{
  const int worlds = *batch, thread = blockIdx.x * blockDim.x + threadIdx.x, threads = gridDim.x * blockDim.x;
#else
extern "C" void {name}(void** p);
static void all_of({pointers}) {{
  const int worlds = *batch, thread = 0, threads = 1;
#endif
  for (int world = thread; world < worlds; world += threads) {{
"""
    end = f"""  }}
}}
#ifndef __CUDACC_RTC__
extern "C" void {name}(void** p) {{ all_of({unpacked}); }}
#endif
"""
    given = () if own else tuple((pool.dtype.name, pool.size) for pool in pools)
    return Source("\n".join([PRELUDE, *e.table_lines, text, *local, *e.lines, end]), given)


def _element_of(leaf: Leaf, text: str):
    """Element k of a leaf, in C."""
    return lambda k: f"{text}[(size_t){_times(k, 1)} * worlds + world]" if leaf.own else f"{text}[{k}]"
