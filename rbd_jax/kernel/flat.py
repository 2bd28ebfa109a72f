"""A jaxpr as one flat list of operations: calls put in their places, what only renames or reshapes left out."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from ..xla import called

#: Calls that are replaced by what they call: primitive -> parameter that holds it.
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "custom_vmap_call": "call",
}  # fmt: skip
LOOPS = frozenset("while scan cond".split())
#: Operations whose result has the elements of the first operand, in their order.
SAME = frozenset("copy expand_dims reshape squeeze stop_gradient".split())
#: The same where no element is repeated or left out.
SAME_IF_WHOLE = frozenset(
    "broadcast_in_dim dynamic_slice reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum slice".split()
)


class Unsupported(Exception):
    """A program cannot become one kernel; the text says for which operation."""


class Value:
    """What an operation takes or gives: its shape and dtype."""

    def __init__(self, shape, dtype):
        self.shape, self.dtype = tuple(shape), np.dtype(dtype)
        self.size = math.prod(self.shape)


class Var(Value):
    """A value that is computed."""


class Constant(Value):
    """An array known in advance."""

    def __init__(self, array: np.ndarray):
        super().__init__(array.shape, array.dtype)
        self.array = array


class Renamed(Value):
    """The elements of a variable in another shape."""

    def __init__(self, shape, var: Var):
        super().__init__(shape, var.dtype)
        self.var = var


def whole(value: Value) -> Var | Constant:
    """The variable or constant behind a value."""
    return value.var if isinstance(value, Renamed) else value


def renamed(value: Value, shape) -> Value:
    """The elements of a value in this shape."""
    value, shape = whole(value), tuple(shape)
    if isinstance(value, Constant):
        return Constant(value.array.reshape(shape))
    return value if value.shape == shape else Renamed(shape, value)


@dataclasses.dataclass(eq=False)
class Op:
    """One operation. bodies: flat programs of a loop or condition."""

    name: str
    ins: list[Value]
    outs: list[Var]
    params: dict
    bodies: tuple[Flat, ...] = ()


@dataclasses.dataclass(eq=False)
class Flat:
    """A program: operations in order."""

    ins: list[Var]
    ops: list[Op]
    outs: list[Value]


def flatten(jaxpr, consts=(), given=()) -> Flat:
    """The flat program of a jaxpr. given: of the first arguments, those that are constants.

    Raises:
      Unsupported: an operation calls others in a way that is not known.
    """
    env: dict = {}
    ins = [_var(v) for v in jaxpr.invars]
    env.update(zip(jaxpr.invars, ins))
    env.update((v, c) for v, c in zip(jaxpr.invars, given) if isinstance(c, Constant))
    env.update(zip(jaxpr.constvars, (Constant(np.asarray(c)) for c in consts)))
    ops: list[Op] = []
    _inline(jaxpr, env, ops)
    return Flat(ins, ops, [_value(env, v) for v in jaxpr.outvars])


def _var(v) -> Var:
    return Var(v.aval.shape, v.aval.dtype)


def _value(env, v) -> Value:
    return Constant(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else env[v]


def _inline(jaxpr, env, ops: list[Op]) -> None:
    for e in jaxpr.eqns:
        name, ins = e.primitive.name, [_value(env, v) for v in e.invars]
        if name in CALLS:
            inner = e.params[CALLS[name]]
            consts = getattr(inner, "consts", ())
            inner = getattr(inner, "jaxpr", inner)
            own = dict(zip(inner.constvars, (Constant(np.asarray(c)) for c in consts)))
            own.update(zip(inner.invars, ins, strict=True))
            _inline(inner, own, ops)
            env.update(zip(e.outvars, (_value(own, v) for v in inner.outvars)))
        elif _same(e, ins):
            if e.params.get("dimensions") and name == "reshape":
                raise Unsupported("reshape with dimensions")
            env[e.outvars[0]] = renamed(ins[0], e.outvars[0].aval.shape)
        elif name not in LOOPS and ins and all(isinstance(v, Constant) for v in ins):
            with jax.ensure_compile_time_eval():
                known = e.primitive.bind(*(jnp.asarray(v.array) for v in ins), **e.params)
            known = known if e.primitive.multiple_results else [known]
            env.update(zip(e.outvars, (Constant(np.asarray(c)) for c in known)))
        else:
            outs = [_var(v) for v in e.outvars]
            env.update(zip(e.outvars, outs))
            ops.append(Op(name, ins, outs, e.params, _bodies(name, ins, e.params)))


def _same(e, ins) -> bool:
    """Whether the result has the elements of the first operand, in their order."""
    name, (out, *_) = e.primitive.name, e.outvars
    if name in SAME:
        return True
    if name == "convert_element_type":
        return np.dtype(out.aval.dtype) == ins[0].dtype
    if name == "transpose":
        order = [j for j in e.params["permutation"] if ins[0].shape[j] != 1]
        return order == sorted(order)
    return name in SAME_IF_WHOLE and out.aval.size == ins[0].size


def _bodies(name: str, ins, params) -> tuple[Flat, ...]:
    if name == "while":
        first, second = params["cond_nconsts"], params["body_nconsts"]
        closed = (params["cond_jaxpr"], ins[:first]), (params["body_jaxpr"], ins[first : first + second])
    elif name == "scan":
        closed = ((params["jaxpr"], ins[: closed_and_carried(params, len(ins))[0]]),)
    elif name == "cond":
        closed = tuple((branch, ins[1:]) for branch in params["branches"])
    elif not name.startswith("scatter") and any(True for _ in called(params)):
        raise Unsupported(f"'{name}' calls others")
    else:
        return ()
    return tuple(flatten(c.jaxpr, c.consts, given) for c, given in closed)


def closed_and_carried(params, count: int) -> tuple[int, int]:
    """How many operands a scan of so many closes over, and how many it carries."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    closed, carried, _ = map(list, params["ft_in"].update(range(count)).unpack())  # JAX 0.11
    return len(closed), len(carried)
