"""Layer 1: what the program must know of XLA's CPU backend.

XLA's CPU backend emits one kernel per output and re-evaluates shared producers in each of them;
``optimization_barrier`` does not stop that, but an operation that XLA takes for expensive and that
has several users is never duplicated. A division by one, where the one is an array whose value XLA
cannot know, costs next to nothing and leaves a finite value bit for bit (measured on a pair update with
twelve outputs: 2.9 ns instead of 12).
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import gc

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters.partial_eval import dce_jaxpr


def opaque_one(tree, dtype) -> jax.Array:
    """A scalar 1 that the compiler cannot fold, as long as it does not know one real array of ``tree``.

    Of what a compiled function closes over it knows all numbers: to take one that it happens to know is to lose what
    ``materialise`` is for.
    """
    real = lambda c: jnp.size(c) and any(jnp.issubdtype(c.dtype, kind) for kind in (jnp.floating, jnp.integer))
    known = [c for c in map(jnp.asarray, jax.tree.leaves(tree)) if real(c)]  # others are no numbers, as random keys
    total = functools.reduce(jnp.add, [jax.lax.stop_gradient(c).ravel()[0].astype(dtype) for c in known])
    return jnp.exp(0.0 * jnp.where(jnp.isfinite(total), total, 0.0))


def for_each_world(one: jax.Array, worlds: int) -> jax.Array:
    """``one`` as an array (worlds,) in which the compiler does not see a scalar: see ``unit``."""
    return one.reshape(1) if worlds == 1 else jnp.minimum(one, jnp.asarray(1.0 + np.arange(worlds) % 2, one.dtype))


def materialise(tree, one: jax.Array | float | None = 1.0):
    """The same values, computed once however many kernels use them. An infinite value becomes NaN, and what is in its
    place in other leaves of its shape may: they share divisors, made of the first of them.

    ``one``: a number, or an array (B,) with one for each world, or one of the leaves' own shape; None leaves the fusion
    to XLA. A thread of a GPU computes everything once.
    """
    if one is None or in_a_thread():
        return tree
    leaves, kind = jax.tree.flatten(tree)
    first, ones, done = {}, {}, []
    for x in leaves:
        like = x.shape, x.dtype
        if like in first and like not in ones:
            ones[like] = unit(first[like], one)
        done.append(x / (ones[like] if like in ones else unit(x, one)))
        first.setdefault(like, done[-1])
    return kind.unflatten(done)


def unit(x: jax.Array, one) -> jax.Array:
    """Ones of the shape of x, which XLA cannot see through.

    Of x's own shape: XLA turns a division by a broadcast array into a product with its reciprocal, which it duplicates
    again. Where x has one number a world they are ``one`` itself, two operations less.
    """
    if jnp.ndim(one):
        if x.shape == one.shape:
            return one
        if x.shape[-1:] != one.shape:  # the same for all worlds
            one = one[0]
        elif x.size == one.size:
            return one.reshape(x.shape)
    # ``one`` has no derivative; x loses it before the product, whose tangent would be traced for nothing
    return one + 0.0 * jax.lax.stop_gradient(x)


def materialise_linear(tree, like: jax.Array, one):
    """``materialise`` in a way that JAX sees is linear: the divisors are made of ``like``, of the leaves' shape."""
    if in_a_thread():
        return tree
    ones = jax.lax.stop_gradient(unit(like, one))
    return jax.tree.map(lambda x: x / ones, tree)


@contextlib.contextmanager
def no_collections():
    """A context in which Python does not look for cycles: JAX makes a million objects to trace a program, of which
    few become garbage, and to go through them again and again takes a third of the time, of a derivative half of it.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


# --- one function of the CPU ---

#: What is being traced becomes "kernels", kernels and functions for its ``piece``s ("pieces"), "one" function, or what
#: a "thread" of a GPU does.
_kind = contextvars.ContextVar("kind", default="kernels")
#: Operations that a ``part`` may have to become one function.
_longest_part = contextvars.ContextVar("longest_part", default=0)

#: Operations that XLA's CPU backend can emit inside one function (not: sort, scatter, sums, linear algebra, callbacks).
PLAIN = frozenset(
    """
    abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type broadcast_in_dim cbrt ceil clamp
    closed_call concatenate cond convert_element_type copy core_call cos cosh custom_jvp_call custom_vjp_call
    custom_vmap_call div dynamic_slice dynamic_update_slice eq eq_to erf exp exp2 expand_dims expm1 floor gather ge gt
    integer_pow iota is_finite jit le log log1p logistic lt max min mul ne neg nextafter not or pad pjit
    population_count pow reduce_and reduce_or rem reshape rev round rsqrt scan select_n shift_left
    shift_right_arithmetic shift_right_logical sign sin sinh slice split sqrt square squeeze stop_gradient sub tan tanh
    transpose while xor
    """.split()
)


def on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def on_gpu() -> bool:
    return jax.default_backend() == "gpu"


def traced_for_a_thread():
    """A context: what is traced within is what one thread of a GPU does for one world."""
    return _traced_as("thread")


def in_a_thread() -> bool:
    """Whether what is being traced is what a thread of a GPU does for one world: what it keeps in memory costs most."""
    return _kind.get() == "thread"


_unset = Primitive("unset")
_unset.def_abstract_eval(lambda shape, dtype: jax.core.ShapedArray(shape, dtype))


def unset(shape: tuple[int, ...], dtype) -> jax.Array:
    """An array of which only what is written is read: zeros, of which a thread of a GPU need not write any."""
    return _unset.bind(shape=shape, dtype=np.dtype(dtype)) if in_a_thread() else jnp.zeros(shape, dtype)


def in_one_function() -> bool:
    """Whether what is being traced is to become one function of the CPU, or of a thread of a GPU.

    There a loop over rows costs nothing but its arithmetic and may end early, and scatters do not exist; elsewhere
    every operation of a loop's body is a kernel that is started anew each time.
    """
    return _kind.get() in ("one", "thread")


def loops_are_cheap() -> bool:
    """Whether what is being traced becomes one function, or its pieces do."""
    return _kind.get() != "kernels"


@contextlib.contextmanager
def _traced_as(kind: str, longest_part: int = 0):
    tokens = _kind.set(kind), _longest_part.set(longest_part or _longest_part.get())
    try:
        yield
    finally:
        _kind.reset(tokens[0])
        _longest_part.reset(tokens[1])


def one_function(run, longest: int | None = None, longest_part: int = 0, long: bool = False):
    """``run``, compiled into one function of the CPU where its operations allow it; no effect elsewhere.

    XLA's CPU backend otherwise starts a kernel for every few operations, which takes longer than a kernel of a few
    hundred worlds. The time to compile a function grows faster than its length: one of more than ``longest``
    operations is cut, so that only each ``piece`` of it is one, or each ``part`` of up to ``longest_part``. Where it is
    likely to be ``long`` the pieces are traced first, as what is traced in vain takes as long as the rest.

    Forward only: loops in ``run`` may end early.

    Raises:
      TypeError: one operation, no loop, makes the only result, of DIVIDED elements or more. XLA divides such a one
        among threads where it finds it worth while, and the emitter of one function then fails (invalid LLVM IR).
    """

    @no_collections()
    def call(*args):
        if not on_cpu():
            return run(*args)
        if long:
            again = lambda *args: run(*args)  # JAX would give this trace of ``run`` itself for that of one function too
            with _traced_as("pieces", longest_part):
                traced, shape = jax.make_jaxpr(again, return_shape=True)(*args)
            length = _length(traced.jaxpr, MARKS)
            if length is None or length > longest:
                out = jax.core.eval_jaxpr(traced.jaxpr, traced.consts, *jax.tree.leaves(args))
                return jax.tree.structure(shape).unflatten(out)
        with _traced_as("one"):
            traced, shape = jax.make_jaxpr(run, return_shape=True)(*args)
        length = _length(traced.jaxpr)
        if length is not None and (longest is None or length <= longest):
            # XLA's emitter of such functions cannot pass an argument by that nothing in them uses: there are none but
            # those that are used, and as XLA may find more than JAX to be of no use, all are results too
            short, used = lean(traced.jaxpr)
            leaves = [c for c, u in zip(jax.tree.leaves(args), used, strict=True) if u]
            if _would_be_divided(short):
                name = getattr(run, "__name__", run)
                raise TypeError(f"one_function: '{name}' has one result, made by one operation; see its docstring")

            def inner(*leaves):
                return jax.core.eval_jaxpr(short, traced.consts, *leaves), leaves

            inner.__name__ = getattr(getattr(run, "func", run), "__name__", "run")  # its name in profiles
            # XLA's own mark of a call that its CPU backend emits as one function; it sets it on tiny loops itself.
            marked = set_xla_metadata(jax.jit(inner)(*leaves), xla_cpu_small_call="true", inlineable="false")
            # JAX does not look through a barrier for what is not used behind it, and XLA takes it away at last
            return jax.tree.structure(shape).unflatten(jax.lax.optimization_barrier(marked)[0])
        if longest is None:
            return run(*args)
        with _traced_as("pieces", longest_part):
            return run(*args)

    return call


def lean(jaxpr):
    """(jaxpr, used): the same without what is of no use, and which of its arguments are left.

    JAX's own elimination leaves ``while`` loops as they are, with all that their bodies close over and all that
    they carry.
    """
    return _Lean()(jaxpr, [True] * len(jaxpr.outvars))


class _Lean:
    """``dce_jaxpr`` that goes into ``while`` loops; each body once for what is needed of it, however deep it lies."""

    def __init__(self):
        self.known = {}

    def __call__(self, jaxpr, results: list[bool], instantiate: bool | list[bool] = False):
        key = id(jaxpr), *results, *np.ravel(instantiate)
        if key not in self.known:
            short = self.loops(dce_jaxpr(jaxpr, results, instantiate=True)[0])
            found = dce_jaxpr(short, [True] * len(short.outvars), instantiate=instantiate)
            self.known[key] = jaxpr, found  # kept, so that no other takes its id
        return self.known[key][1]

    def loops(self, jaxpr):
        """``jaxpr`` whose ``while`` loops take in and carry what their results depend on, and no more."""

        def inside(value):
            if _closed(value):
                return value.replace(jaxpr=self.loops(value.jaxpr))
            if hasattr(value, "eqns"):
                return self.loops(value)
            return tuple(map(inside, value)) if type(value) is tuple else value

        needed = {v for v in jaxpr.outvars if not hasattr(v, "val")}
        eqns = []
        for e in reversed(jaxpr.eqns):
            if e.primitive.name == "while":
                e = self.loop(e, [v in needed for v in e.outvars])
            elif any(True for _ in called(e.params)):
                e = e.replace(params={k: inside(v) for k, v in e.params.items()})
            needed |= {v for v in e.invars if not hasattr(v, "val")}
            eqns.append(e)
        return jaxpr.replace(eqns=eqns[::-1])

    def loop(self, e, needed: list[bool]):
        """A ``while`` of whose results some are needed."""
        cond, body = e.params["cond_jaxpr"], e.params["body_jaxpr"]
        first, count = e.params["cond_nconsts"], e.params["body_nconsts"]
        asked = dce_jaxpr(cond.jaxpr, [True])[1][first:]
        before = None
        while before != needed:
            before = needed
            taken = self(body.jaxpr, needed)[1]
            needed = [n or a or t for n, a, t in zip(needed, asked, taken[count:], strict=True)]
        short, taken = self(body.jaxpr, needed, [False] * count + needed)
        test = dce_jaxpr(cond.jaxpr, [True], instantiate=[True] * first + needed)[0]
        keep = [True] * first + taken[:count] + needed
        params = e.params | {
            "cond_jaxpr": cond.replace(jaxpr=test), "body_jaxpr": body.replace(jaxpr=short),
            "body_nconsts": sum(taken[:count]),
        }  # fmt: skip
        pick = lambda items, which: [x for x, k in zip(items, which, strict=True) if k]
        return e.replace(invars=pick(e.invars, keep), outvars=pick(e.outvars, needed), params=params)


def _closed(value) -> bool:
    return hasattr(value, "jaxpr") and hasattr(value, "consts")


#: Elements from which on XLA may divide an operation among threads.
DIVIDED = 4096


def _would_be_divided(jaxpr) -> bool:
    """Whether one operation, which is no loop, makes the only result, and a large one."""
    if len(jaxpr.outvars) != 1 or jaxpr.outvars[0].aval.size < DIVIDED:
        return False
    last = [e.primitive.name for e in jaxpr.eqns if jaxpr.outvars[0] in e.outvars]
    return last not in (["while"], ["scan"], ["cond"], ["dynamic_update_slice"])


def piece(run, longest: int | None = None, long: bool = False):
    """``run(*args)``, one function where the program around it is cut into pieces; else a part of that program."""

    def call(*args):
        if _kind.get() != "pieces":
            return run(*args)
        with _traced_as("kernels"):
            return one_function(run, longest, long=long)(*args)

    return call


def part(run):
    """As ``piece``, of what is itself made of pieces: those are the functions where it is long."""
    return lambda *args: piece(run, _longest_part.get(), long=True)(*args)


#: What marks a call as one function.
MARKS = frozenset({"optimization_barrier", "xla_metadata_value"})


def _length(jaxpr, apart: frozenset = frozenset()) -> int | None:
    """Operations of a jaxpr with all that it calls but those ``apart``; None where one has no place in one function."""
    total = 0
    for e in jaxpr.eqns:
        if e.primitive.name in apart:
            continue
        if e.primitive.name not in PLAIN or e.effects:
            return None
        inside = [_length(j, apart) for j in called(e.params)]
        if None in inside:
            return None
        total += sum(inside) or 1
    return total


#: Operations that wait, in one of XLA's threads, for work that they hand to its other threads, or for Python.
WAITING = frozenset(
    """
    cholesky cholesky_update custom_call debug_callback eig eigh ffi_call hessenberg householder_product io_callback lu
    ormqr pure_callback qr geqrf geqp3 schur svd triangular_solve tridiagonal tridiagonal_solve
    """.split()
)


def waits(jaxpr) -> bool:
    """Whether a program has such operations: two of it at a time can wait for each other for ever on a CPU."""
    return any(e.primitive.name in WAITING or any(map(waits, called(e.params))) for e in jaxpr.eqns)


def called(params):
    """The jaxprs among an operation's parameters."""
    for value in params.values():
        for item in value if isinstance(value, (tuple, list)) else (value,):
            item = getattr(item, "jaxpr", item)
            if hasattr(item, "eqns"):
                yield item


#: Longer axes are gone through in a loop.
UNROLL = 16


def summed(c: jax.Array, axis: int = 0) -> jax.Array:
    """The sum of ``c`` over one axis; XLA's own sums have no place in one function."""
    return _reduced(c, axis, jnp.sum, jnp.add)


def largest(c: jax.Array, axis: int = 0) -> jax.Array:
    """The largest of ``c`` over one axis, see ``summed``."""
    return _reduced(c, axis, jnp.max, jnp.maximum)


def _reduced(c: jax.Array, axis: int, whole, both) -> jax.Array:
    count = c.shape[axis]
    if not in_one_function() or not count:
        return whole(c, axis=axis)
    if count <= UNROLL:
        parts = [jax.lax.index_in_dim(c, k, axis, keepdims=False) for k in range(count)]
        return functools.reduce(both, parts)
    at = lambda k: jax.lax.dynamic_index_in_dim(c, k, axis, keepdims=False)
    return jax.lax.fori_loop(1, count, lambda k, total: both(total, at(k)), at(0))
