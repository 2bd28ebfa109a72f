"""Layer 5: groups of contact rows as one group of points, for solvers of coupled systems.

What a solver does to a group it writes into the program once for each of them, and in a derivative several times more.
Here groups of a kind become one: their points (S, P, B), one group after the other, are (1, K, B). Fixed geometry
becomes a body after the last one, which does not move (``Contacts.anchored``).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..spatial import zeros_like
from ..struct import static, struct
from ..xla import materialise
from .dense import Contacts, is_coupled, jacobian
from .rows import Index


@struct
class Joint:
    """Which groups became which.

    members: the numbers of the groups of every joined one. shapes: (S, P) of every group.
    """

    members: tuple = static(default=())
    shapes: tuple = static(default=())

    def split(self, trees) -> tuple:
        """Trees of the joined groups, arrays (1, K, B), as those of the groups, (S, P, B)."""
        out = [None] * sum(map(len, self.members))
        for members, tree in zip(self.members, trees):
            if len(members) == 1:
                out[members[0]] = tree
                continue
            start = 0
            for k in members:
                s, p = self.shapes[k]
                cut = lambda c, at=start, s=s, p=p: c[0, at : at + s * p].reshape(s, p, c.shape[-1])
                out[k] = jax.tree.map(cut, tree)
                start += s * p
        return tuple(out)


def join(cs, trees, bodies: int, one) -> tuple[tuple, tuple, Joint]:
    """Groups that are alike as one, with their Jacobians, where two bodies touch; else the groups as they are.

    Args:
      cs: ``Contacts`` of all groups. trees: of every group a tree of arrays that broadcast to (S, P, B).
      bodies: how many there are.

    Returns:
      The joined groups, their trees, and how to get back.
    """
    if not is_coupled(cs):
        return cs, trees, Joint(tuple((k,) for k in range(len(cs))))
    kinds = {}
    for k, (c, tree) in enumerate(zip(cs, trees)):
        kinds.setdefault(_kind(k, c, tree), []).append(k)
    new, new_trees = [], []
    for members in kinds.values():
        if len(members) == 1:
            new.append(cs[members[0]])
            new_trees.append(trees[members[0]])
            continue
        some, tree = _joined([cs[k] for k in members], [trees[k] for k in members], bodies)
        tree, arrays = materialise((tree, (some.n, some.t1, some.t2, some.rb, some.ra)), one)
        new.append(some._with(**dict(zip(("n", "t1", "t2", "rb", "ra"), arrays))))
        new_trees.append(tree)
    size = 6 if any(c.rb is not None for c in cs) else 3
    new = tuple(c._with(jacobian=jacobian(c, size, one)) for c in new)
    return new, tuple(new_trees), Joint(tuple(map(tuple, kinds.values())), tuple(c.live.shape[:2] for c in cs))


def _kind(number: int, c: Contacts, tree):
    if not isinstance(c.b, Index):
        return number
    return c.friction, c.torsion, c.rolling, c.t1 is None, c.rb is None, jax.tree.structure(tree)


def _joined(cs: list[Contacts], trees: list, bodies: int) -> tuple[Contacts, object]:
    worlds = max(c.live.shape[-1] for c in cs)
    shapes = tuple(c.live.shape[:2] for c in cs)

    def points(*leaves):
        """(1, K, B) of leaves that broadcast to (S, P, B)."""
        flat = lambda x, shape: jnp.broadcast_to(x, (*shape, worlds)).reshape(1, -1, worlds)
        return jnp.concatenate([flat(x, shape) for x, shape in zip(leaves, shapes)], axis=1)

    def pairs(*leaves):
        return jnp.concatenate([jnp.broadcast_to(x, (p, worlds)) for x, (_, p) in zip(leaves, shapes)])

    first = cs[0]
    free = [c.a is None for c in cs]
    a = ra = rb = None
    if first.rb is not None:
        rb = jax.tree.map(points, *(c.rb for c in cs))
    if not all(free):
        rows = lambda c: np.full(len(c.b), bodies) if c.a is None else c.a.rows
        a = Index(np.concatenate([rows(c) for c in cs]))
        if first.rb is not None:
            ra = jax.tree.map(points, *(zeros_like(c.rb) if c.a is None else c.ra for c in cs))
    axes = jax.tree.map(pairs, *((c.n, c.t1, c.t2) for c in cs))
    live, b = points(*(c.live for c in cs)), Index(np.concatenate([c.b.rows for c in cs]))
    kinds = first.friction, first.torsion, first.rolling
    joined = Contacts(*axes, live, b, a, rb, ra, *kinds, shapes, a is not None and any(free))
    return joined, jax.tree.map(points, *trees)
