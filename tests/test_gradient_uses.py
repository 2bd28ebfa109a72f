"""Three uses of gradients reach their goal, in fewer evaluations than a search that sees values only."""

import pathlib
import sys

import jax
import pytest

pytest.importorskip("optax")
pytest.importorskip("scipy")
sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

from benchmarks import gradient_uses as uses  # noqa: E402


@pytest.mark.parametrize("name", uses.USES)
def test_gradient_needs_fewer_evaluations_than_values_alone(name):
    use = uses.USES[name](dt=1 / 60)
    evaluate = uses.Counted(jax.value_and_grad(use.loss), use.start)
    x, loss = uses.descend(evaluate, use.start, use.goal)
    spent = len(evaluate.losses)
    assert use.error(x, loss) <= use.tolerance < use.error(use.start, evaluate.losses[0])
    # the same program without its gradient, which saves a compilation
    x, loss = uses.search(lambda x: evaluate(x)[0], use.start, use.goal, limit=2 * spent)
    assert loss > use.goal and use.error(x, loss) > use.tolerance
