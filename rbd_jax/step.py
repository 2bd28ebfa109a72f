"""Layer 7: one step of all worlds, in the hot layout.

    kick:   v* = v + h a,  L* = L + h tau          (all forces but contact)
    solve:  contact impulses at the poses of the start of the step
    move:   poses with the solved velocities

A body that touches nothing moves ballistically (x + h v + h^2 a / 2); one that touches moves with
its end velocity along the contact normal and with the mean velocity along the surface.
Source: solver order of Moreau-Jean time stepping; the switch is ours.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from . import implicit
from .bodies import Bodies
from .detect import chosen, detect, everything, of_places, put_back
from .events import advance_to_impacts, carried
from .loops import repeat
from .model import Model, Params, params
from .solvers import single
from .solvers.base import Problem, Solution
from .solvers.restitution import normal_velocity, targets
from .solvers.rows import Impulses, Rows, add_rows, add_trees, by_pair, inverse_inertia, spread, take, take_tree
from .spatial import Quat, Vec3, where, zeros_like
from .state import Memory, State, World, Wrench, to_hot, to_public
from .status import Status
from .struct import struct
from .xla import for_each_world, materialise, opaque_one, part, piece, summed

FROZEN = int(Status.NOT_FINITE)


def limit(dtype) -> float:
    """Largest size of a state: 2.6e6 in float32, 2.4e51 in float64 (SI units).

    The size is the root of the sum of squares of all positions, velocities, quaternions and angular velocities (their
    bound |L| / least moment). Its sixth power is finite: a step forms energies and their quotients, whose derivatives
    have fourth powers, times stiffness or 1 / mass. (Measured in float32: steps at speeds of 1e7 m/s have derivatives
    that are not finite. At 2.6e6 m a position resolves 0.25 m.)
    """
    return float(jnp.finfo(dtype).max) ** (1 / 6)


# --- public state <-> hot world ---


def with_memory(model: Model, state: State) -> State:
    """``state`` with the memory that this model's method keeps, cold where it has none."""
    if state.memory is not None:
        return state
    s, batch = model.structure, state.batch_shape
    dtype = state.x.x.dtype
    zero = lambda *shape: jnp.zeros((*batch, *shape), dtype)
    contacts, feature, pairs = [], [], []
    for g in s.groups:
        shape = (g.slots, g.capacity or len(g.a))
        lam = zero(*shape)
        entries = 1 + 2 * g.friction + g.torsion + 2 * g.rolling
        contacts.append(Impulses(*[lam] * entries))
        feature.append(jnp.full((*batch, shape[1]), -1, jnp.int32) if g.features else None)
        pairs.append(jnp.full((*batch, shape[1]), len(g.a), jnp.int32) if g.capacity else None)
    L = None
    if s.attitude and not s.isotropic:
        nan = jnp.full_like(state.x.x, jnp.nan)
        L = Vec3(nan, nan, nan)
    return state._with(memory=Memory(L, None, tuple(contacts), tuple(feature), tuple(pairs)))


@jax.custom_jvp
def _exactly(computed, remembered):
    """``remembered`` where it agrees with ``computed`` to rounding; derivatives are those of ``computed``."""
    eps = 16 * jnp.finfo(computed.x.dtype).eps
    d = computed - remembered
    near = d.dot(d) <= eps * eps * computed.dot(computed)
    return where(near, remembered, computed)


@_exactly.defjvp
def _exactly_jvp(primals, tangents):
    return _exactly(*primals), tangents[0]


def grown(state: State, batch: tuple[int, ...]) -> State:
    """``state`` with all batch axes of the worlds; its own are the first of them."""
    own = state.batch_shape
    grow = lambda c: c.reshape(*own, *(1,) * (len(batch) - len(own)), *c.shape[len(own) :])
    return jax.tree.map(lambda c: jnp.broadcast_to(grow(c), (*batch, *c.shape[len(own) :])), state)


def unfit(model: Model, state: State) -> jax.Array:
    """Worlds that cannot be stepped, bool (batch...): a number is not finite, or the state is out of range.

    ``state`` is grown and has its memory.
    """
    s, memory, axes = model.structure, state.memory, len(state.batch_shape)
    over = lambda c, first: summed(c.reshape(*c.shape[:first], -1), first)
    moving = (state.x, state.v, *((state.q, state.w) if s.attitude else ()))
    size = over(sum(c * c for c in jax.tree.leaves(moving)), axes)
    for tree in (state.kinematic, memory.R, *memory.contacts):  # leaves of one shape: a single sum for each
        if tree is not None:
            size = size + over(sum(c * 0 for c in jax.tree.leaves(tree)), axes)
    bad = ~(size <= limit(size.dtype) ** 2)
    shared = []
    for name, value in model.leaves():
        if name.startswith("pair_"):  # there NaN means: not given
            value = jnp.where(jnp.isnan(value), 0.0, value)
        own = value.ndim - model.base_ndim(name)
        if own:
            wrong = over(value * 0, own) != 0
            bad = bad | wrong.reshape(*wrong.shape, *(1,) * (axes - own))
        else:
            shared.append(value.ravel())
    return bad | (summed(jnp.concatenate(shared) * 0) != 0)


def marked(state: State, lost: jax.Array) -> State:
    """``state`` with the worlds ``lost`` frozen from the start."""
    return state._with(status=state.status | jnp.where(lost, jnp.uint32(FROZEN), jnp.uint32(0)))


def harmless(model: Model, state: State, lost: jax.Array) -> tuple[Model, State]:
    """``state`` with other bodies in the worlds ``lost``: at rest, a metre apart; a model of finite numbers.

    Zero times a derivative at NaN is NaN: what is not finite must not enter a program that is differentiated, even
    where nothing depends on the result.
    """

    def put(tree, *values):
        at = lambda c: jnp.reshape(lost, (*lost.shape, *(1,) * (c.ndim - lost.ndim)))
        leaves, kind = jax.tree.flatten(tree)
        values = values if len(values) > 1 else values * len(leaves)
        return kind.unflatten([jnp.where(at(c), jnp.asarray(v, c.dtype), c) for c, v in zip(leaves, values)])

    memory, kinematic = state.memory, state.kinematic
    if kinematic is not None:
        line = -1.0 - np.arange(kinematic.x.x.shape[-1])
        kinematic = kinematic._with(
            x=put(kinematic.x, line, 0, 0), q=put(kinematic.q, 1, 0, 0, 0), v=put(kinematic.v, 0), w=put(kinematic.w, 0)
        )
    R = memory.R
    state = marked(state, lost)._with(
        x=put(state.x, np.arange(state.n), 0, 0),
        v=put(state.v, 0),
        q=put(state.q, 1, 0, 0, 0),
        w=put(state.w, 0),
        kinematic=kinematic,
        memory=memory._with(
            L=put(memory.L, 0),
            R=None if R is None else put(R, 1, 0, 0, 0, 1, 0, 0, 0, 1),
            contacts=put(memory.contacts, 0),
        ),
    )
    finite = {}
    for name, value in model.leaves():
        fine = jnp.isfinite(value) | (jnp.isnan(value) if name.startswith("pair_") else False)
        finite[name] = jnp.where(fine, value, 1.0)
    return model._with(**finite), state


def restored(state: State, given: State, lost: jax.Array) -> State:
    """``state`` (final, or a trajectory of it) with the worlds ``lost`` as they were given, as constants: the
    derivative of an objective at a number that is not finite is none itself, even where it is multiplied by zero.
    """
    samples = state.x.x.ndim > given.x.x.ndim

    def back(new, old):
        old = jax.lax.stop_gradient(jnp.expand_dims(old, lost.ndim) if samples else old)
        return jnp.where(jnp.reshape(lost, (*lost.shape, *(1,) * (new.ndim - lost.ndim))), old, new)

    names = ["x", "v", "q", "w", "kinematic"]
    if state.memory is not None:
        names.append("memory")
        if given.memory.R is None:
            given = given._with(memory=given.memory._with(R=state.memory.R))
    return state._with(**{k: jax.tree.map(back, getattr(state, k), getattr(given, k)) for k in names})


def enter(
    model: Model, state: State, batch: tuple[int, ...], substeps: jax.Array | None = None, control=None
) -> tuple[Params, World]:
    """Hot numbers and hot world of a public state whose leaves have batch axes ``batch``.

    substeps: see ``params``. control: any other numbers of the program, see ``opaque_one``.
    """
    s = model.structure
    state = grown(state, batch)
    hot = to_hot(state, batch)
    known = [value for _, value in model.leaves()]
    one = opaque_one((known, state.x, state.v, state.q, state.w, state.step, control), model.dt.dtype)
    p = params(model, batch, one, substeps)._with(one=for_each_world(one, hot.step.shape[0]))
    memory = hot.memory
    if s.attitude:
        q = hot.q if p.principal is None else hot.q @ p.principal
        if memory.L is not None:  # else I omega would differ from L by more than rounding after many single steps
            q = piece(Quat.normalised)(q)
        L = piece(lambda inertia, q, w: inertia.momentum(q, w))(p.inertia, q, hot.w)
        if memory.L is not None:
            L = _exactly(L, memory.L)
        R = memory.R
        if R is None and model.method.integrator.carries_matrix:
            R = q.mat()
        bodies = Bodies(hot.x, hot.v, q, L, R)
        quat = spin = None
    else:
        bodies = Bodies(hot.x, hot.v)
        quat, spin = hot.q, hot.w
    return p, World(
        bodies, quat, spin, hot.kinematic, memory.contacts, memory.feature, memory.pairs, hot.step, hot.status
    )


def leave(model: Model, p: Params, world: World, batch: tuple[int, ...] | None, memory: bool = True) -> State:
    """The public state of a hot world; with ``batch`` None the same in the hot layout."""
    bodies = world.bodies
    if bodies.q is None:
        quat, spin = world.quat, world.spin
    else:
        quat = bodies.q if p.principal is None else bodies.q @ p.principal.conj()
        spin = piece(_angular_velocity)(p, bodies)
    parts = model.method.substeps if p.substeps is None else p.substeps.astype(p.h.dtype)
    dt = jnp.broadcast_to(p.h * parts, world.step.shape)
    L = None if model.structure.isotropic else bodies.L
    kept = Memory(L, bodies.R, world.contacts, world.feature, world.pairs) if memory else None
    hot = State(bodies.x, bodies.v, quat, spin, world.step, world.status, dt, world.kinematic, kept)
    return hot if batch is None else to_public(hot, batch)


def _angular_velocity(p: Params, bodies: Bodies) -> Vec3:
    """omega of the state. For isotropic bodies (L / I) I is L again to the bit, if the division is a true one:
    by an array of L's own shape, as XLA multiplies with the reciprocal of a broadcast one.
    """
    if p.inertia.isotropic:
        return bodies.L.map(lambda c: c / (p.inertia.moments + 0.0 * c))
    return p.inertia.velocity(bodies.q, bodies.L)


# --- forces ---


def acceleration(p: Params, wrench: Wrench | None, bodies: Bodies):
    """Acceleration [m/s^2] and torque [N m] of gravity, wrench (hot Vec3s) and drag; None = absent."""
    a = tau = None
    if p.gravity is not None:
        a = Vec3(*(jnp.broadcast_to(c, bodies.x.x.shape) for c in (p.gravity.x, p.gravity.y, p.gravity.z)))
    if wrench is not None:
        if wrench.force is not None:
            push = wrench.force * p.inv_mass
            a = push if a is None else a + push
        if bodies.L is not None:
            tau = wrench.torque
    if p.drag is not None:
        linear, angular = p.drag
        slow = bodies.v * -linear
        a = slow if a is None else a + slow
        if bodies.L is not None:
            damp = bodies.L * -angular
            tau = damp if tau is None else tau + damp
    return a, tau


def free_force(p: Params, wrench: Wrench | None):
    """The force function of ``Integrator.advance``."""

    def force(bodies: Bodies):
        return acceleration(p, wrench, bodies)

    force.constant = p.drag is None
    force.damped = p.drag is not None
    return force


# --- the step ---


def advance(model: Model, p: Params, world: World, wrench: Wrench | None) -> World:
    """One step of dt: ``substeps`` equal parts, then the step counter and the finite check."""
    return watched(model, p, world, wrench, None)[0]


#: Steps of a block after which is asked whether a world was lost in it. To ask after every step, and to choose between
#: two states, takes a third of the time of a ball.
BLOCK = 64


def advance_in_blocks(model: Model, p: Params, world: World, wrench: Wrench | None, count) -> World:
    """``advance``, ``count`` times (may be traced): the same worlds, lost ones held; not to be differentiated.

    A block in which a world is lost is taken again, step by step. For steps that are short: around one of boxes the
    second loop gains nothing, and it takes a third longer to compile.
    """

    def step(_, carry):
        world, largest = carry
        new, _ = substeps(model, p, world, wrench)
        # of the state that is there, not of the new one, which would be computed again for it
        return new._with(step=new.step + 1), piece(_larger)(largest, world, p)

    def block(carry):
        done, singly, old = carry
        careful = singly > 0
        length = jnp.where(careful, 1, jnp.minimum(count - done, BLOCK))
        new, largest = repeat(0, length, step, (old, jnp.zeros_like(_square(old, p))))
        kept, ok = _kept(old, new, _larger(largest, new, p))
        taken = careful | (ok | _is_lost(old)).all()
        singly = jnp.where(taken, jnp.maximum(singly - 1, 0), BLOCK)
        return done + jnp.where(taken, length, 0), singly, where(taken, kept, old)

    start = (jnp.int32(0), jnp.int32(0), world)
    return jax.lax.while_loop(lambda carry: carry[0] < count, block, start)[2]


def watched(model: Model, p: Params, world: World, wrench: Wrench | None, watch):
    """``advance``, and what ``watch`` returned for every substep, leaves (substeps, ..., B); None for no watch.

    watch(old, new, problem, solution): the worlds before and after a substep and what was solved in it, both None
    without contact; of an integrator with several stages those of the first. It adds operations of its own only.
    """
    whole = lambda p, world, wrench: substeps(model, p, world, wrench, watch)
    if watch is None:
        return held(whole, p, world, wrench)
    whole, closed = opened(whole, p, world, wrench)
    return held(lambda p, world, wrench, closed: whole(p, world, wrench, *closed), p, world, wrench, closed)


def substeps(model: Model, p: Params, world: World, wrench: Wrench | None, watch=None):
    """The world after all parts of a step, whatever has become of it, and what ``watch`` says of each."""
    part = lambda world, _: _substep(model, p, world, wrench, watch)
    if p.substeps is not None:
        return repeat(0, p.substeps, lambda _, world: part(world, None)[0], world), None
    count = model.method.substeps
    if count > 1:
        return jax.lax.scan(part, world, None, length=count)
    new, seen = part(world, None)
    return new, jax.tree.map(lambda c: c[None], seen)


def held(step, p: Params, world: World, wrench, *others):
    """``step(p, world, wrench, *others) -> (World, seen)``, where a world that is lost in it stays as it was.

    So does its derivative: it is the identity with respect to ``world``, and zero with respect to the rest. A lost
    world may have any derivative in the step, and zero times an infinite one is NaN, which a sum over worlds would
    carry into numbers that they share. Hence tangents are zero before they enter the step as well as behind it, in
    forward mode and so, transposed, in reverse mode; shared numbers of ``p`` and ``wrench`` become one for each world
    there. ``others`` may have any shapes; what a lost world does to their derivatives is left to ``step``.
    ``step`` closes over static values only.

    Reverse mode keeps ``world`` and what was ``found``, and computes the rest of the step again. To keep all that it
    needs takes longer: it is a thousand small arrays, each written and read by a kernel of its own (a hundred steps of
    ten boxes and balls: 12 MB and 145 ms, now 0.7 MB and 135 ms).
    """

    @jax.custom_jvp
    def call(p, world, wrench, *others):
        new, seen = step(p, world, wrench, *others)
        return piece(_freeze)(world, new, p)[0], seen

    def rule(primals, tangents):
        p, world, *_ = primals
        values, changes, put, at = moving(primals, tangents)
        count = len(jax.tree.leaves(primals[:3]))
        wide = lambda c: jnp.broadcast_to(c, (*jnp.shape(c)[:-1], *world.step.shape))
        each = lambda f, leaves: [f(c) if i < count else c for i, c in zip(at, leaves)]
        real = lambda c: jnp.issubdtype(c.dtype, jnp.inexact)

        whole = implicit.recomputed(lambda *values: step(*put(values)))

        def floats(*values):
            leaves, tree = jax.tree.flatten(whole(*values))
            return [c for c in leaves if real(c)], ([None if real(c) else c for c in leaves], tree)

        floating, linear, (leaves, tree) = jax.linearize(floats, *each(wide, values), has_aux=True)
        given = iter(floating)
        new, seen = tree.unflatten([next(given) if c is None else c for c in leaves])
        kept, ok = _freeze(world, new, p)
        slopes = iter(linear(*each(lambda c: jnp.where(ok, wide(c), 0.0), changes)))

        def ahead(c, before=None):
            """Tangent of a result: that of the step, or the one before it."""
            if not real(c):
                return np.zeros(c.shape, jax.dtypes.float0)
            slope = next(slopes)
            if slope.shape[-1:] != ok.shape:  # of all worlds together
                return slope
            return jnp.where(ok, slope, 0.0 if isinstance(before, SymbolicZero) or before is None else before)

        flat, kind = jax.tree.flatten(kept)
        change = kind.unflatten([ahead(c, before) for c, before in zip(flat, kind.flatten_up_to(tangents[1]))])
        return (kept, seen), (change, jax.tree.map(ahead, seen))

    call.defjvp(rule, symbolic_zeros=True)
    return call(p, world, wrench, *others)


def moving(primals, tangents):
    """Of a rule with symbolic zeros: the leaves that change, their changes, a function that puts other values for
    them into the tree of ``primals``, and which leaves they are.
    """
    leaves, tree = jax.tree.flatten(primals)
    changes = tree.flatten_up_to(tangents)
    at = [i for i, c in enumerate(changes) if not isinstance(c, SymbolicZero)]

    def put(values):
        merged = list(leaves)
        for i, value in zip(at, values):
            merged[i] = value
        return tree.unflatten(merged)

    return [leaves[i] for i in at], [changes[i] for i in at], put, at


def opened(f, *examples):
    """``f`` as a function (*examples, *closed) that closes over no traced value, and the values it closed over.

    A rule of differentiation must not close over any. (``jax.closure_convert`` leaves those in that cannot have a
    derivative, such as random keys.)
    """
    closed, shape = jax.make_jaxpr(f, return_shape=True)(*examples)
    count, tree = len(jax.tree.leaves(examples)), jax.tree.structure(shape)

    def g(*args):
        leaves = jax.tree.leaves(args)
        return tree.unflatten(jax.core.eval_jaxpr(closed.jaxpr, leaves[count:], *leaves[:count]))

    return g, list(closed.consts)


def _freeze(old: World, new: World, p: Params) -> tuple[World, jax.Array]:
    """A world that is no longer finite or leaves the range stays at its last state in range and says so.

    Also whether a world made the step, (B,).
    """
    return _kept(old, new._with(step=new.step + 1), materialise(_square(new, p), p.one))


def _kept(old: World, new: World, square: jax.Array) -> tuple[World, jax.Array]:
    """``new``, or ``old`` where a world was lost before or now (``square``: of its size, squared); where it is new."""
    fits = square <= limit(square.dtype) ** 2  # false for NaN
    ok = fits & ~_is_lost(old)
    status = jnp.where(_is_lost(old), old.status, jnp.where(fits, new.status, new.status | jnp.uint32(FROZEN)))
    return where(ok, new, old)._with(status=status), ok


def _larger(square: jax.Array, world: World, p: Params) -> jax.Array:
    return jnp.maximum(square, _square(world, p))  # NaN stays


def _is_lost(world: World) -> jax.Array:
    return (world.status & jnp.uint32(FROZEN)) != 0


def _square(world: World, p: Params) -> jax.Array:
    """Size of every world, squared, see ``limit``; (B,)."""
    bodies = world.bodies
    squares = [c * c for c in jax.tree.leaves(bodies._with(L=None))]
    if bodies.L is not None:
        moments = p.inertia.moments
        least = moments if p.inertia.isotropic else jnp.minimum(jnp.minimum(moments.x, moments.y), moments.z)
        squares.append(bodies.L.dot(bodies.L) * (1.0 / (least * least)))
    while len(squares) > 1:  # in pairs: of one world the next step waits for the sum, and in a row each for the other
        squares = [functools.reduce(jnp.add, squares[i : i + 2]) for i in range(0, len(squares), 2)]
    return summed(squares[0])


def _substep(model: Model, p: Params, world: World, wrench: Wrench | None, watch):
    """The world after a substep, and what ``watch`` says of it."""
    new, problem, solution = _solved(model, p, world, wrench)
    return new, None if watch is None else watch(world, new, problem, solution)


def _solved(model: Model, p: Params, world: World, wrench: Wrench | None):
    """The world after a substep, the contact problem in it and its solution (None without contact)."""
    s, integrator = model.structure, model.method.integrator
    if not s.groups:
        bodies = integrator.advance(world.bodies, free_force(p, wrench), p.inertia, p.h)
        return world._with(bodies=bodies, kinematic=carried(world.kinematic, p.h)), None, None
    if model.method.solver.level == "force":
        return _force_step(model, p, world, wrench)
    nominal = None
    if model.method.events and any(g.restitution for g in s.groups):
        world, left, more = _to_impacts(model, p, world, wrench)
        p, nominal = p._with(h=left), p.h
    old = world.bodies
    contacts = part(lambda p, world: detect(s, p, world, model.method.reach))(p, world)
    if nominal is not None:  # impulses are kept as those of a whole step
        rest = lambda c, meets: c._with(
            warm=jax.tree.map(lambda x: x * (p.h / nominal), c.warm),
            rows=c.rows if c.rows.e is None or c.pairs is not None else c.rows._with(meets=of_places(c, meets)),
        )
        contacts = tuple(rest(c, meets) for c, meets in zip(contacts, more))
    predict = lambda *args: _predicted(integrator, *args)
    v, L, *turning = piece(predict)(p, wrench, old)
    problem = _problem(p, old, v, turning, contacts)._with(
        contact=model.method.contact, nominal=nominal, smoothing=p.smoothing
    )
    solution = part(model.method.solver.solve)(problem)
    if any(rows.e is not None and rows.slots > 1 for rows in problem.rows):
        solution = _passive(p, problem, solution)
    finish = lambda *args: _moved(integrator, *args)
    return piece(finish)(p, world, L, problem, contacts, solution), problem, solution


def _predicted(integrator, p: Params, wrench: Wrench | None, old: Bodies):
    """Velocity and angular momentum without contact, inverse inertia, spin at the start and without contact."""
    a, tau = acceleration(p, wrench, old)
    v, L = integrator.kick(old, a, tau, p.inertia, p.h)
    return v, L, *spins(p, old, L)


def spins(p: Params, old: Bodies, L: Vec3 | None):
    """World inverse inertia, spin at the start and with the angular momentum L; None without attitude."""
    if L is None:
        return None, None, None
    inverse = materialise(inverse_inertia(p.inertia, old.q), p.one)
    return inverse, inverse @ old.L, inverse @ L


def _moved(integrator, p: Params, world: World, L, problem: Problem, contacts, solution: Solution) -> World:
    """The world after the contact impulses."""
    old, v = world.bodies, problem.v
    v1 = v + solution.impulse * p.inv_mass
    L1 = L if solution.angular_impulse is None else L + solution.angular_impulse
    if solution.warm:
        v1, L1 = materialise((v1, L1), p.one)
    v_move = v1 if solution.v_move is None else solution.v_move
    L_move = L1
    if solution.w_move is not None:
        L_move = materialise(p.inertia.momentum(old.q, solution.w_move), p.one)
    impacts = _impacts(p, problem, solution, v1) if integrator.order >= 2 else None
    rest, v_rest = solution, v1
    if impacts is not None:
        rest = solution._with(contacts=impacts.contacts)
        v_rest = v1 - impacts.impulse * p.inv_mass
        if L is not None:
            L_move = L_move - impacts.turn / p.h
            L1 = L1 + impacts.balance
    bodies = integrator.move(old, v_move, L_move, p.inertia, p.h)
    x = bodies.x
    if integrator.order >= 2:
        x = x + _correction(p, problem, rest, old.v, v_rest)
    if impacts is not None:
        x = x + impacts.shift
    bodies = bodies._with(x=x, v=v1, L=L1)
    return _remember(world, bodies, p, contacts, solution, problem)


def _to_impacts(model: Model, p: Params, world: World, wrench: Wrench | None):
    """What ``events.advance_to_impacts`` gives."""
    support = turn = zeros_like(world.bodies.v)
    selected = []
    contacts = detect(model.structure, p, world, model.method.reach)
    for g, gp, c in zip(model.structure.groups, p.groups, contacts):
        impacts = everything(g, gp) if c.pairs is None else chosen(g, gp, c.pairs)
        selected.append(impacts if g.restitution else None)
        J = c.rows.n * c.warm.n
        if c.warm.t1 is not None:
            t1, t2 = c.rows.tangents
            J = J + t1 * c.warm.t1 + t2 * c.warm.t2
        slots = lambda v: v.map(summed)
        support = spread(support, c.rows, slots(J))
        if world.bodies.L is not None:
            turn = _spread_sides(
                turn, c.rows, slots(c.rows.rb.cross(J)), None if c.rows.a is None else slots(c.rows.ra.cross(J))
            )
    forces = acceleration(p, wrench, world.bodies)
    return advance_to_impacts(model, p, world, tuple(selected), *forces, (support, turn))


def _problem(p: Params, old: Bodies, v: Vec3, turning, contacts) -> Problem:
    inverse, w0, w = turning  # as of ``spins``
    return Problem(
        rows=tuple(c.rows for c in contacts),
        v0=old.v,
        v=v,
        w0=w0,
        w=w,
        inv_mass=p.inv_mass,
        h=p.h,
        warm=tuple(c.warm for c in contacts),
        load=tuple(jnp.abs(c.last.n) for c in contacts),  # negative: an impact
        one=p.one,
        q=old.q,
        inertia=p.inertia,
        inv_inertia=inverse,
        stacked=any(c.rows.slots > 1 for c in contacts) and any(c.rows.a is not None for c in contacts),
    )


def _remember(world: World, bodies: Bodies, p: Params, contacts, solution: Solution, problem: Problem) -> World:
    status = world.status
    for c in contacts:
        if c.overflow is not None:
            status = status | jnp.where(c.overflow, jnp.uint32(int(Status.CAPACITY)), jnp.uint32(0))
    if solution.overflow is not None:
        status = status | jnp.where(solution.overflow, jnp.uint32(int(Status.CAPACITY)), jnp.uint32(0))
    if solution.unconverged is not None:
        status = status | jnp.where(solution.unconverged, jnp.uint32(int(Status.NOT_CONVERGED)), jnp.uint32(0))
    lasting = solution.contacts
    if solution.warm:
        mark = lambda rows, lam: _marked(rows, lam, problem)
        lasting = tuple(by_pair(mark, c.rows, lam) for c, lam in zip(contacts, lasting))
    if problem.nominal is not None:
        whole = lambda lam: jax.tree.map(lambda c: c * jnp.where(lam.n < 0, 1.0, problem.nominal / problem.h), lam)
        lasting = tuple(whole(lam) for lam in lasting)
    lasting = tuple(put_back(c, lam, old) for c, lam, old in zip(contacts, lasting, world.contacts))
    features = [w if w is None else put_back(c, c.rows.feature, w) for c, w in zip(contacts, world.feature)]
    shape = lambda new, old: jax.tree.map(lambda a, b: jnp.broadcast_to(a, b.shape).astype(b.dtype), new, old)
    return world._with(
        bodies=bodies,
        kinematic=carried(world.kinematic, p.h),
        contacts=tuple(shape(c, w) for c, w in zip(lasting, world.contacts)),
        feature=tuple(None if w is None else shape(f, w) for f, w in zip(features, world.feature)),
        pairs=tuple(c.pairs for c in contacts),
        status=status,
    )


def _marked(rows: Rows, lam: Impulses, problem: Problem) -> Impulses:
    """Impulses to remember. Those of a pair that collided in this step are kept with a negative normal part:
    the next step does not start from them (which would add energy), yet they can be reported.

    A slot collided when it approached faster than twice what this step's accelerations give its bodies.
    """
    u0 = normal_velocity(rows, problem.v0, problem.w0)
    kick = problem.v - problem.v0
    gain = jnp.sqrt(take(kick.dot(kick), rows.b))
    if rows.a is not None:
        gain = gain + jnp.sqrt(take(kick.dot(kick), rows.a))
    hit = (lam.n > 0) & (u0 < -2.0 * jax.lax.stop_gradient(gain))
    return lam._with(n=jnp.where(hit.any(axis=0), -lam.n, lam.n))


def _force_step(model: Model, p: Params, world: World, wrench: Wrench | None):
    """Contact as a force of the state, integrated like any other (MuJoCo's scheme)."""
    s, integrator, solver = model.structure, model.method.integrator, model.method.solver
    record = []

    def force(bodies: Bodies):
        contacts = detect(s, p, world._with(bodies=bodies), model.method.reach)
        a, tau = acceleration(p, wrench, bodies)
        v, L = bodies.v if a is None else bodies.v + a * p.h, bodies.L
        problem = _problem(p, bodies, v, spins(p, bodies, L), contacts)
        if L is not None:
            # w at constant inertia: gyroscopic and applied torque at the start of the step
            w0 = problem.w0
            push = bodies.L.cross(w0)
            push = push if tau is None else push + tau
            problem = problem._with(w=w0 + (problem.inv_inertia @ push) * p.h)
        solution = solver.solve(problem)
        record.append((contacts, solution, problem))
        push = solution.impulse * (p.inv_mass / p.h)
        turn = solution.angular_impulse
        a = push if a is None else a + push
        if turn is not None:
            tau = turn / p.h if tau is None else tau + turn / p.h
        return a, tau

    force.constant = False
    bodies = integrator.advance(world.bodies, force, p.inertia, p.h)
    contacts, solution, problem = record[0]
    return _remember(world, bodies, p, contacts, solution, problem), problem, solution


def _correction(p: Params, problem: Problem, solution: Solution, v0: Vec3, v1: Vec3) -> Vec3:
    """What is added to x + h v: the ballistic or tangential half step.

    d = h (v0 - v1) / 2 turns the end velocity into the mean velocity. A body in contact takes only
    its part along the surface (perpendicular to its total normal impulse), which is what makes a
    sliding distance second order without lifting or sinking.
    """
    push = zeros_like(v0)
    if single.applies(problem):  # one contact a body: the direction is its normal, no quotient need be taken
        (rows,), (lam,) = problem.rows, solution.contacts
        n = spread(push, rows, rows.n * jnp.where(lam.n[0] > 0, 1.0, 0.0).astype(v0.x.dtype))
        d = (v0 - v1) * (0.5 * p.h)
        return d - n * n.dot(d)
    for rows, lam in zip(problem.rows, solution.contacts):
        push = spread(push, rows, rows.n * summed(lam.n))
    if solution.warm:
        push = materialise(push, p.one)
    s = push.dot(push)
    touched = s > 0
    d = (v0 - v1) * (0.5 * p.h)
    along = jnp.where(touched, push.dot(d) / jnp.where(touched, s, 1.0), 0.0)
    return d - push * along


@struct
class _Impacts:
    """Effect of impacts within the step: x + shift, L of the move + turn, L at the end + balance."""

    impulse: Vec3  # of the impacts alone [N s]
    shift: Vec3
    turn: Vec3 | None
    balance: Vec3 | None
    contacts: tuple[Impulses, ...]  # what is left: the impulses of resting contacts


def _impacts(p: Params, problem: Problem, solution: Solution, v1: Vec3) -> _Impacts | None:
    """Impacts act at their own instant t, not at the start of the step.

    An impulse J at t leaves x at x0 + h v1 - t J / m - h^2 a / 2, and the attitude t longer with the old
    angular momentum. Between two bodies the shift keeps their centre of mass; the couple of the shifted
    impulses, t J x (vB - vA), goes to their spins, so that angular momentum is kept to rounding.
    """
    if not any(rows.e is not None for rows in problem.rows):
        return None
    zero = zeros_like(problem.v)
    spin = problem.w is not None
    impulse, shift = zero, zero
    turn = balance = zero if spin else None
    left = []
    for rows, lam in zip(problem.rows, solution.contacts):
        if rows.e is None:
            left.append(lam)
            continue
        rest, J, late, *turns, couple = by_pair(lambda *args: _impacts_of(problem, v1, *args), rows, lam)
        left.append(rest)
        impulse = spread(impulse, rows, J)
        shift = spread(shift, rows, late, -1.0)
        if not spin:
            continue
        turn = _spread_sides(turn, rows, *turns)
        if rows.a is not None:
            balance = _spread_sides(balance, rows, couple, couple * -1.0)
    return _Impacts(impulse, shift * p.inv_mass, turn, balance, tuple(left))


def _impacts_of(problem: Problem, v1: Vec3, rows: Rows, lam: Impulses):
    """Of every pair: the impulses that are no impact, J and J t of those that are, the turns t r x J of B and A,
    and the couple that balances them."""
    events = targets(rows, problem)
    hit, at = events.active, problem.h - events.left
    mine = jax.tree.map(lambda c: jnp.where(hit, c, 0.0), lam)
    rest = jax.tree.map(lambda c: jnp.where(hit, 0.0, c), lam)
    J = rows.n * mine.n
    if mine.t1 is not None:
        t1, t2 = rows.tangents
        J = J + t1 * mine.t1 + t2 * mine.t2
    slots = lambda v: v.map(summed)
    late = slots(J * at)
    if problem.w is None:
        return rest, slots(J), late, None, None, None
    turn = slots(rows.rb.cross(J) * at)
    if rows.a is None:
        return rest, slots(J), late, turn, None, None
    couple = late.cross(take_tree(v1, rows.b) - take_tree(v1, rows.a)) * 0.5
    return rest, slots(J), late, turn, slots(rows.ra.cross(J) * at), couple


def _passive(p: Params, problem: Problem, solution: Solution) -> Solution:
    """Contact impulses scaled down where an impact would add energy.

    Newton's restitution law with friction at several points of a body can (Kane 1985). With u-, u+ the
    relative velocities just before and after the impulses p (at their own instant; a resting contact acts
    over the whole step, so at its middle), theta p do the work theta (p.u- + theta p.(u+ - u-) / 2). A single
    frictionless impact has p.u+ = -e p.u-; theta is the largest value in 0..1 that gives no more than that,
    with e = 1 for resting contacts: one a body where bodies touch fixed geometry only, else one a world.
    """
    accel = (problem.v - problem.v0) / p.h
    v = problem.v + solution.impulse * p.inv_mass
    w = None
    if problem.w is not None:
        w = problem.w + problem.inv_inertia @ solution.angular_impulse
    coupled = any(rows.a is not None for rows in problem.rows)
    before = after = most = jnp.zeros_like(problem.v.x)
    for rows, lam in zip(problem.rows, solution.contacts):
        left, e = 0.5 * p.h, 1.0
        if rows.e is not None:
            events = targets(rows, problem)
            left, e = (jnp.where(events.active, x, y) for x, y in ((events.left, left), (rows.e, e)))
        b, a = (_power(rows, lam, v_, w_, accel, left) for v_, w_ in ((problem.v, problem.w), (v, w)))
        before, after = add_rows(before, rows.b, summed(b)), add_rows(after, rows.b, summed(a))
        most = add_rows(most, rows.b, summed(-e * b))
    if coupled:
        before, after, most = (summed(c)[None] for c in (before, after, most))
    gains = after > most
    change = jnp.where(gains, after - before, 1.0)
    theta = jnp.where(gains, jnp.clip((most - before) / jnp.where(change > 0, change, 1.0), 0.0, 1.0), 1.0)
    theta = materialise(theta, p.one)
    scaled = lambda v, base: None if v is None else base + (v - base) * theta
    rate = lambda rows: theta if coupled else take(theta, rows.b)
    return solution._with(
        impulse=solution.impulse * theta,
        angular_impulse=None if w is None else solution.angular_impulse * theta,
        contacts=tuple(
            jax.tree.map(lambda c, rows=rows: c * rate(rows), lam) for rows, lam in zip(problem.rows, solution.contacts)
        ),
        v_move=scaled(solution.v_move, problem.v),
        w_move=scaled(solution.w_move, problem.w),
    )


def _power(rows: Rows, lam: Impulses, v: Vec3, w: Vec3 | None, accel: Vec3, left) -> jax.Array:
    """p . u of every slot, (S, P, B) [J], u being ``left`` [s] before the end of the step."""
    p = rows.n * lam.n
    if lam.t1 is not None:
        t1, t2 = rows.tangents
        p = p + t1 * lam.t1 + t2 * lam.t2

    def side(index, arm):
        u = take_tree(v, index) - take_tree(accel, index) * left
        return u if w is None else u + take_tree(w, index).cross(arm)

    u = side(rows.b, rows.rb)
    if rows.a is not None:
        u = u - side(rows.a, rows.ra)
    if rows.surface is not None:
        u = u - rows.surface
    return p.dot(u)


def _spread_sides(total: Vec3, rows, b: Vec3, a: Vec3 | None) -> Vec3:
    """``total`` with ``b`` added to body B and ``a`` subtracted from body A."""
    total = add_trees(total, rows.b, b, rows.filled)
    return total if a is None else add_trees(total, rows.a, a, rows.filled, -1.0)
