"""Tasks for learners: laws of reset and step, what other libraries ask of them, and that they are learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbd_jax.learn import TASKS, AutoReset, make, ppo, through, training, unroll, watch

NAMES = sorted(TASKS)
QUICK = ["push", "catch"]
WORLDS = 8


@pytest.fixture(scope="session")
def tasks():
    return {name: make(name) for name in NAMES}


@pytest.fixture(scope="session")
def batched(tasks):
    """(reset, step) of a batch, compiled."""
    return {name: (jax.jit(jax.vmap(t.reset)), jax.jit(jax.vmap(t.step))) for name, t in tasks.items()}


def keys(n, seed=0):
    return jax.random.split(jax.random.key(seed), n)


def same(a, b):
    data = lambda c: jax.random.key_data(c) if jnp.issubdtype(c.dtype, jax.dtypes.prng_key) else c
    return all(np.array_equal(data(x), data(y), equal_nan=True) for x, y in zip(*map(jax.tree.leaves, (a, b))))


# --- reset and step ---


@pytest.mark.parametrize("name", NAMES)
def test_a_step_hands_on_what_it_was_given(name, tasks, batched):
    """Same structure, shapes and dtypes, so that scan takes it; observations and rewards are finite."""
    task, (reset, step) = tasks[name], batched[name]
    state, obs = reset(keys(WORLDS))
    assert obs.shape == (WORLDS, task.observation_size) and np.isfinite(obs).all()
    after, out = step(state, jnp.zeros((WORLDS, task.action_size)))
    assert jax.tree.structure(state) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(after)):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
    assert out.obs.shape == obs.shape and np.isfinite(out.obs).all()
    assert out.reward.shape == out.terminated.shape == out.truncated.shape == (WORLDS,)
    assert np.isfinite(out.reward).all() and not out.done.any() and (after.steps == 1).all()
    assert (out.info["status"] == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_key_is_the_episode(name, batched):
    reset, step = batched[name]
    state, _ = reset(keys(WORLDS))
    assert same(state, reset(keys(WORLDS))[0]) and not same(state, reset(keys(WORLDS, 1))[0])
    assert len({tuple(o) for o in np.asarray(reset(keys(WORLDS))[1])}) == WORLDS


def test_raw_and_typed_keys(tasks):
    task = tasks["push"]
    raw, typed = jax.random.PRNGKey(3), jax.random.key(3)
    a, b = task.reset(raw), task.reset(typed)
    assert np.array_equal(a[1], b[1])
    for key in (raw, typed):
        state, _ = AutoReset(task).reset(key)
        state, out = AutoReset(task).step(state, jnp.zeros(2))
        assert jax.tree.structure(state) == jax.tree.structure(task.reset(key)[0])


def test_action_pushes_where_it_says(tasks, batched):
    reset, step = batched["push"]
    state, _ = reset(keys(WORLDS))
    for _ in range(4):
        state, out = step(state, jnp.tile(jnp.array([1.0, 0.0]), (WORLDS, 1)))
    assert (state.sim.vel[:, 0, 0] > 0.2).all() and np.abs(state.sim.vel[:, 0, 1]).max() < 1e-5
    far, _ = step(state, jnp.full((WORLDS, 2), 50.0))
    one, _ = step(state, jnp.full((WORLDS, 2), 1.0))
    assert same(far, one)  # actions are clipped to [-1, 1]


def test_the_plate_tilts_and_stops(tasks, batched):
    from rbd_jax.learn.tasks.balance import TILT, _tilt

    reset, step = batched["balance"]
    state, _ = reset(keys(WORLDS))
    for _ in range(5):
        state, _ = step(state, jnp.tile(jnp.array([1.0, -0.5]), (WORLDS, 1)))
    tilt = jax.vmap(_tilt)(state.sim)
    np.testing.assert_allclose(tilt[:, 0], TILT, atol=0.02)
    assert (tilt[:, 1] < -0.15).all() and (tilt[:, 1] > -TILT - 0.02).all()
    assert (state.sim.vel[:, 0, 0] > 0).any()  # it slides to where it is low


def test_the_clock_truncates_and_a_loss_terminates(tasks):
    task = make("push", episode=3)
    state, _ = task.reset(jax.random.key(0))
    seen = []
    for _ in range(3):
        state, out = jax.jit(task.step)(state, jnp.zeros(2))
        seen.append((bool(out.terminated), bool(out.truncated)))
    assert seen == [(False, False), (False, False), (False, True)]
    lost = state._with(sim=state.sim.replace(vel=state.sim.vel * jnp.nan), steps=jnp.int32(0))
    _, out = jax.jit(task.step)(lost, jnp.zeros(2))
    assert out.terminated and not out.truncated and out.reward == 0 and out.info["status"] != 0


def test_a_restart_is_fresh_and_keeps_what_ended(tasks):
    task = make("push", episode=2)
    for first in (False, True):
        auto = AutoReset(task, first=first)
        state, begun = auto.reset(jax.random.key(0))
        step = jax.jit(auto.step)
        state, out = step(state, jnp.ones(2))
        assert np.array_equal(out.obs, out.final_obs)
        plain, last = jax.jit(task.step)(state, jnp.ones(2))
        state, out = step(state, jnp.ones(2))
        assert out.truncated and state.steps == 0 and state.sim.step == 0
        assert np.array_equal(out.final_obs, last.obs) and not np.array_equal(out.obs, last.obs)
        assert np.array_equal(out.obs, begun) == first
        np.testing.assert_array_equal(out.obs, task.observe(state.sim, state.goal))
    starts = []
    auto, state = AutoReset(task), task.reset(jax.random.key(0))[0]
    for _ in range(6):
        state, out = step(state, jnp.ones(2)) if first is None else jax.jit(auto.step)(state, jnp.ones(2))
        if out.truncated:
            starts.append(tuple(np.asarray(out.obs)))
    assert len(set(starts)) == 3


def test_worlds_have_numbers_of_their_own():
    """Twice the mass, half the speed; drawn anew at every start; another batch has no part in it."""
    task = make("push", randomise=lambda key, model: {"mass": model.mass * jax.random.uniform(key, (), minval=0.5)})
    state, _ = jax.vmap(task.reset)(keys(64))
    mass = np.asarray(state.numbers["mass"])[:, 0]
    assert len(set(mass)) == 64 and mass.min() >= 0.5 and mass.max() <= 1.0
    state, _ = jax.jit(jax.vmap(task.step))(state, jnp.tile(jnp.array([0.2, 0.0]), (64, 1)))
    speed = np.asarray(state.sim.vel[:, 0, 0])
    # a rolling ball is accelerated by F / (m + I / r^2); the inertia stays that of the scene
    np.testing.assert_allclose(speed * (mass + 0.4), (speed * (mass + 0.4)).mean(), rtol=0.02)
    auto = jax.jit(jax.vmap(AutoReset(make("push", episode=1, randomise=task.randomise)).step))
    state, _ = auto(jax.vmap(task.reset)(keys(64))[0], jnp.zeros((64, 2)))
    assert not np.intersect1d(np.asarray(state.numbers["mass"])[:, 0], mass).size


@pytest.mark.parametrize("action", [np.zeros(3), np.zeros((1, 2)), 0.0, np.array([np.nan, 0]), np.array([0, np.inf])])
def test_a_bad_action_is_refused(tasks, action):
    state, _ = tasks["push"].reset(jax.random.key(0))
    with pytest.raises(ValueError, match="task 'push': action"):
        tasks["push"].step(state, action)


def test_a_traced_action_that_is_not_finite_ends_the_world(tasks, batched):
    reset, step = batched["push"]
    state, _ = reset(keys(WORLDS))
    _, out = step(state, jnp.zeros((WORLDS, 2)).at[3, 0].set(jnp.nan))
    assert out.terminated[3] and not np.delete(np.asarray(out.done), 3).any()
    assert np.isfinite(out.reward).all() and np.isfinite(out.obs).all()


def test_bad_tasks_are_refused():
    with pytest.raises(ValueError, match="unknown task 'juggle'; tasks: .*push"):
        make("juggle")
    for bad in ({"substeps": 0}, {"episode": 1.5}, {"episode": True}):
        with pytest.raises(ValueError, match="must be an integer >= 1"):
            make("push", **bad)
    with pytest.raises(ValueError, match="no leaf 'colour'"):
        make("push", randomise=lambda key, model: {"colour": jnp.ones(())})
    with pytest.raises(ValueError, match="Model.mass has shape"):
        make("push", randomise=lambda key, model: {"mass": jnp.ones(7)})


def test_a_task_of_ones_own(tasks):
    """Four methods are a task."""
    from rbd_jax.learn.tasks.push import Push

    class Away(Push):
        name = "away"

        def judge(self, before, sim, goal, action):
            return jnp.abs(sim.pos[0, :2]).sum(), jnp.bool(False), {}

    state, _ = Away().reset(jax.random.key(0))
    assert Away().step(state, jnp.zeros(2))[1].reward > 0


# --- derivatives ---


def test_gradient_of_a_return_is_right(tasks):
    """Through policy, task and engine, against central differences in float64."""
    with jax.enable_x64(True):
        task = make("push")
        state, _ = task.reset(jax.random.key(2))

        def total(action):
            s, reward = state, 0.0
            for _ in range(3):
                s, out = task.step(s, action)
                reward += out.reward
            return reward

        total = jax.jit(total)
        at = jnp.array([0.3, -0.2])
        slope = jax.grad(total)(at)
        for k in range(2):
            d = 1e-5 * jnp.eye(2)[k]
            np.testing.assert_allclose(slope[k], (total(at + d) - total(at - d)) / 2e-5, rtol=1e-5)


# --- learners ---


def test_advantages_in_closed_form():
    """One world that ends at the third step: by hand, terminated and truncated."""
    reward, value, after = (jnp.array(c)[:, None] for c in ([1.0, 2, 3, 4], [0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 2.0, 0.5]))
    g, lam = 0.9, 0.8
    for over in (True, False):
        ended = jnp.array([False, False, True, False])[:, None]
        out = training.advantages(reward, value, after, ended & over, ended, g, lam)[:, 0]
        d = [1 + g * 0.5 - 0.5, 2 + g * 0.5 - 0.5, 3 + (0 if over else g * 2.0) - 0.5, 4 + g * 0.5 - 0.5]
        want = [d[0] + g * lam * (d[1] + g * lam * d[2]), d[1] + g * lam * d[2], d[2], d[3]]
        np.testing.assert_allclose(out, want, rtol=1e-6)


def test_normaliser_merges_batches():
    from rbd_jax.learn.policy import normaliser

    x = np.random.default_rng(0).normal(3.0, 2.0, (100, 4))
    seen = normaliser(4)
    for part in np.split(x, [10, 45]):
        seen = seen.merged(jnp.asarray(part, jnp.float32))
    np.testing.assert_allclose(seen.mean, x.mean(0), rtol=1e-5)
    np.testing.assert_allclose(seen.m2 / seen.count, x.var(0), rtol=1e-5)


@pytest.fixture(scope="session")
def by_chance(tasks):
    return training.evaluate(tasks["push"], training.at_random(tasks["push"]), jax.random.key(9), 128).mean()


def test_ppo_learns_to_push(tasks, by_chance):
    """A third of what chance loses, in 2e5 control steps."""
    learner, history = ppo.train(tasks["push"], jax.random.key(0), steps=250_000)
    score = training.evaluate(tasks["push"], learner.policy, jax.random.key(9), 128).mean()
    assert history[-1].steps >= 250_000 and score > by_chance / 2.5, (score, by_chance)
    # goes on from where it was
    again, more = ppo.train(tasks["push"], jax.random.key(5), steps=history[-1].steps + 1, learner=learner)
    assert len(more) == 1 and more[0].iteration == history[-1].iteration + 1
    assert not same(again.policy, learner.policy)


def test_gradients_through_the_simulator_learn_to_push(tasks, by_chance):
    """As well in a quarter of the steps."""
    learner, history = through.train(tasks["push"], jax.random.key(0), steps=60_000)
    score = training.evaluate(tasks["push"], learner.policy, jax.random.key(9), 128).mean()
    assert score > by_chance / 2.5 and not any(p.lost_gradient for p in history), (score, by_chance)


def test_training_needs_an_end(tasks):
    with pytest.raises(ValueError, match="give seconds, steps"):
        ppo.train(tasks["push"], jax.random.key(0))
    with pytest.raises(ValueError, match="minibatches = 7 must divide"):
        ppo.PPO(minibatches=7)


# --- other libraries ---


def test_gymnasium_accepts_the_single_environment(tasks):
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    from rbd_jax.learn.adapters.gymnasium import SingleEnv

    for name in QUICK:
        env = SingleEnv(tasks[name])
        check_env(env, skip_render_check=True)
        a, b = (env.reset(seed=4)[0] for _ in range(2))
        assert np.array_equal(a, b)
        with pytest.raises(ValueError, match="action"):
            env.step(np.zeros(5, np.float32))
        with pytest.raises(ValueError, match="finite"):
            env.step(np.full(2, np.nan, np.float32))
    with pytest.raises(gymnasium.error.ResetNeeded):
        SingleEnv(tasks["push"]).step(np.zeros(2, np.float32))


def test_gymnasium_vector_environment_same_step(tasks):
    pytest.importorskip("gymnasium")
    from gymnasium.wrappers.vector import RecordEpisodeStatistics

    from rbd_jax.learn.adapters.gymnasium import VectorEnv

    task = make("push", episode=5)
    env = RecordEpisodeStatistics(VectorEnv(task, WORLDS))
    obs, _ = env.reset(seed=1)
    total = np.zeros(WORLDS)
    for k in range(5):
        before = obs
        obs, reward, over, cut, info = env.step(np.zeros((WORLDS, 2), np.float32))
        total += reward
        assert env.observation_space.contains(obs) and not over.any() and cut.all() == (k == 4)
    assert (info["episode"]["l"] == 5).all() and info["_final_obs"].all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    final = np.stack(info["final_obs"])
    assert np.abs(final - before).max() < 0.2 and np.abs(obs - final).max() > 0.2  # the last one, not the next
    again, _ = env.reset(seed=1)
    assert np.array_equal(env.reset(seed=1)[0], again)
    seeds = list(range(WORLDS))
    assert np.array_equal(env.reset(seed=seeds)[0], env.reset(seed=seeds)[0])
    with pytest.raises(ValueError, match=r"action has shape \(8,\), it needs \(8, 2\)"):
        env.step(np.zeros(WORLDS))


def test_gymnasium_vector_environment_next_step():
    pytest.importorskip("gymnasium")
    from gymnasium.vector import AutoresetMode

    from rbd_jax.learn.adapters.gymnasium import VectorEnv

    env = VectorEnv(make("push", episode=3), WORLDS, AutoresetMode.NEXT_STEP)
    env.reset(seed=1)
    act = np.zeros((WORLDS, 2), np.float32)
    for _ in range(3):
        last, _, over, cut, _ = env.step(act)
    assert cut.all()
    obs, reward, over, cut, _ = env.step(act)
    assert not (over | cut).any() and (reward == 0).all() and np.abs(obs - last).max() > 0.2
    assert (env.step(act)[1] != 0).all()
    mask = np.arange(WORLDS) == 2
    kept = env._obs.copy()
    obs, _ = env.reset(options={"reset_mask": mask})
    assert np.array_equal(obs[~mask], kept[~mask]) and not np.array_equal(obs[mask], kept[mask])


def test_brax_interface(tasks):
    """What its trainers need (tried against Brax itself where that is installed)."""
    from rbd_jax.learn.adapters.brax import BraxEnv

    env = BraxEnv(tasks["push"])
    for key in (jax.random.PRNGKey(0), jax.random.key(0)):
        state = env.reset(key)
        after = jax.jit(env.step)(state, jnp.zeros(2))
        assert jax.tree.structure(state) == jax.tree.structure(after)
        assert after.reward.dtype == after.done.dtype == jnp.float32 and set(state.metrics) == set(after.metrics)


def test_brax_ppo_trains_unchanged():
    pytest.importorskip("brax")
    from brax.training.agents.ppo import train as brax_ppo

    from rbd_jax.learn.adapters.brax import BraxEnv, mend_brax

    mend_brax()
    seen = []
    brax_ppo.train(
        environment=BraxEnv(make("push")), num_timesteps=60_000, episode_length=100, num_envs=64, batch_size=32,
        num_minibatches=8, unroll_length=10, num_updates_per_batch=4, num_evals=2, num_eval_envs=32, seed=0,
        learning_rate=1e-3, normalize_observations=True, progress_fn=lambda n, m: seen.append(m["eval/episode_reward"]),
    )  # fmt: skip
    assert seen[-1] > seen[0]


def test_gymnax_interface(tasks):
    """A trainer in the manner of purejaxrl: vmap of reset and step, scan over time."""
    from rbd_jax.learn.adapters.gymnax import GymnaxEnv

    env = GymnaxEnv(make("push", episode=4))
    params = env.default_params
    obs, state = jax.vmap(env.reset, in_axes=(0, None))(keys(WORLDS), params)

    def one(carry, key):
        obs, state, rng = carry
        rng, act, step = jax.random.split(rng, 3)
        action = jax.vmap(env.action_space(params).sample)(jax.random.split(act, WORLDS))
        obs, state, reward, done, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            jax.random.split(step, WORLDS), state, action, params
        )
        return (obs, state, rng), (done, info["discount"])

    _, (done, discount) = jax.lax.scan(one, (obs, state, jax.random.PRNGKey(0)), None, length=12)
    assert done.sum(0).tolist() == [3] * WORLDS and (discount == 1).all()
    assert obs.shape[1:] == env.observation_space(params).shape
    six = GymnaxEnv(make("push"), outputs=6)
    assert len(six.step(jax.random.key(0), six.reset(jax.random.key(0))[1], jnp.zeros(2))) == 6


def test_unroll_is_step_by_step(tasks):
    """A loop of the same steps, and worlds that do not know of each other."""
    task = AutoReset(make("catch", episode=3))
    state, _ = jax.vmap(task.reset)(keys(WORLDS))
    act = lambda obs, key: 0.5 * jnp.ones((obs.shape[0], 2))
    end, (obs, action, out) = jax.jit(lambda s, k: unroll(task, act, s, 7, k))(state, jax.random.key(0))
    one = jax.tree.map(lambda c: c[2:3], state)
    step = jax.jit(jax.vmap(task.step))
    for k in range(7):
        one, seen = step(one, 0.5 * jnp.ones((1, 2)))
        np.testing.assert_allclose(out.final_obs[k, 2], seen.final_obs[0], atol=2e-5)
        assert out.truncated[k, 2] == seen.truncated[0]


def test_a_policy_is_watched(tasks):
    """An episode a world, at the times of its steps, standing still once it is over; the first sample is the start."""
    task = make("catch", episode=30)
    film = watch(task, training.at_random(task), jax.random.key(3), worlds=3)
    W, T, n = film.shape
    assert W == 3 and 10 < T <= 31 and film.dynamic == task.model.n
    np.testing.assert_allclose(film.time, task.period * np.arange(T), atol=1e-5)
    moves = np.abs(np.diff(film.pos, axis=1)).max((2, 3)) > 0  # (world, interval)
    assert moves[:, :5].all()
    for world in moves:
        assert not (np.diff(world.astype(int)) > 0).any(), "what stopped stays"
    assert not moves[:, -1].all(), "the throws end at different times"
    with pytest.raises(ValueError, match="worlds = 0"):
        watch(task, training.at_random(task), jax.random.key(3), worlds=0)
