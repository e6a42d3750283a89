"""The operators of gpo_ppo.py against closed forms, slow loops, autograd and torch's own optimizers."""

import math
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

import gpo_ppo
from gpo_ppo import make_net, make_policy

NAN = math.nan


@pytest.fixture(autouse=True)
def no_autograd():
    """As in training; references turn it on where they need it."""
    with torch.no_grad():
        yield


def generators(n, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(n)]


def random_stack(sizes, members, seed=0, log_std=False, noise=0.2):
    """Rows [members, P] some way from initialization, in double precision so that references agree closely."""
    rows = gpo_ppo.init_rows(generators(members, seed), sizes, 1.0, log_std).double()
    return rows + noise * torch.randn(rows.shape, dtype=rows.dtype, generator=torch.Generator().manual_seed(seed))


def reference_mlp(row, sizes, obs):
    """A tanh MLP read from one flat row, layer by layer; obs [N, in]. Returns its output and where its parameters end."""
    at, h = 0, obs
    for k, (n_in, n_out) in enumerate(zip(sizes, sizes[1:])):
        W, b = row[at : at + n_out * n_in].view(n_out, n_in), row[at + n_out * n_in : at + n_out * (n_in + 1)]
        at += n_out * (n_in + 1)
        h = h @ W.T + b
        h = torch.tanh(h) if k < len(sizes) - 2 else h
    return h, at


def reference_policy(row, args, obs):
    """The policy as a torch.distributions object, for obs [N, obs_dim]."""
    mean, at = reference_mlp(row, gpo_ppo.policy_sizes(args), obs)
    return Independent(Normal(mean, row[at : at + args.act_dim].exp().expand_as(mean)), 1)


def autograd(loss, row):
    """Gradient of loss(row) by autograd."""
    with torch.enable_grad():
        leaf = row.clone().requires_grad_()
        return torch.autograd.grad(loss(leaf), leaf)[0]


def sampled_batch(args, row, seed, samples=40):
    """A batch that the policy in `row` collected, as make_batches gives it, with made-up observations and advantages."""
    g = torch.Generator().manual_seed(seed)
    obs = torch.randn(samples, args.obs_dim, dtype=row.dtype, generator=g)
    acting = reference_policy(row, args, obs)
    actions = acting.mean + acting.stddev * torch.randn(acting.mean.shape, dtype=row.dtype, generator=g)
    return SimpleNamespace(
        obs=obs.T[None].contiguous(),
        actions=actions.T[None].contiguous(),
        mean=acting.mean.T[None].contiguous(),
        log_std=acting.stddev[0].log()[None, :, None],
        log_probs=acting.log_prob(actions)[None],
        advantages=torch.randn(1, samples, dtype=row.dtype, generator=g),
    )


def reference_loss(args, row, batches, kl_coef, kl_hinge, clip):
    """-L^PPO with data-sharing; batches: own, then borrowed. A capped ratio is a constant times log pi."""
    loss = 0.0
    for k, batch in enumerate(batches):
        policy = reference_policy(row, args, batch.obs[0].T)
        log_prob = policy.log_prob(batch.actions[0].T)
        ratio = torch.exp(log_prob - batch.log_probs[0])
        if k > 0:
            ratio = torch.where(ratio > clip, clip * log_prob, ratio) if clip < math.inf else ratio
        loss = loss - (ratio * batch.advantages[0]).mean()
        if k == 0:
            old = Independent(Normal(batch.mean[0].T, batch.log_std[0].T.exp()), 1)
            kl = kl_divergence(old, policy).mean()
            loss = loss + kl_coef * kl + kl_hinge * torch.clamp(kl - 2 * args.kl_target, min=0) ** 2
    return loss


# ---------------------------------------------------------------- networks and the optimizer


def test_forward_and_backward_are_those_of_member_by_member_mlps():
    sizes = (5, 32, 32, 3)
    flat, x = random_stack(sizes, 3, log_std=True), torch.randn(3, 5, 17, dtype=torch.double)
    net, weights = make_net(flat.clone(), sizes, log_std=True), torch.randn(3, 3, 17, dtype=torch.double)
    activations = gpo_ppo.forward(net, x)
    gpo_ppo.backward(net, activations, weights.clone())
    for i in range(3):
        torch.testing.assert_close(activations[-1][i].T, reference_mlp(flat[i], sizes, x[i].T)[0])
        expected = autograd(lambda row, i=i: (reference_mlp(row, sizes, x[i].T)[0] * weights[i].T).sum(), flat[i])
        torch.testing.assert_close(net.grad[i], expected)


def test_initialization_is_orthogonal_and_a_members_own(make_args):
    args = make_args()
    sizes = gpo_ppo.policy_sizes(args)
    rows = gpo_ppo.init_rows(generators(3), sizes, 0.01, log_std=True)
    assert rows.shape[1] % 16 == 0
    for W, b, *_ in make_policy(rows, args).layers:
        scale = 0.01 if W.shape[1] == args.act_dim else math.sqrt(2)
        for w in W:
            gram = w @ w.T if w.shape[0] <= w.shape[1] else w.T @ w
            torch.testing.assert_close(gram, scale**2 * torch.eye(len(gram)), atol=1e-5, rtol=0)
        assert not b.any()
    assert not make_policy(rows, args).log_std.any()
    alone = gpo_ppo.init_rows(generators(3)[2:], sizes, 0.01, log_std=True)
    assert torch.equal(alone[0], rows[2]) and not torch.equal(rows[0], rows[1])


def test_adam_step_is_torchs_adam_for_every_member():
    sizes, rate = (4, 32, 1), 3e-3
    net = make_net(random_stack(sizes, 3).float(), sizes)
    leaves = [row.clone().requires_grad_() for row in net.flat]
    optimizers = [torch.optim.Adam([leaf], lr=rate, eps=1e-5) for leaf in leaves]
    gpo_ppo.adam(net)
    generator = torch.Generator().manual_seed(1)
    for step in range(20):
        net.grad.copy_(torch.randn(net.grad.shape, generator=generator) * 10.0 ** (step % 5 - 3))
        for leaf, optimizer, grad in zip(leaves, optimizers, net.grad):
            leaf.grad = grad.clone()
            optimizer.step()
        gpo_ppo.adam_step(net, rate)
    torch.testing.assert_close(net.flat, torch.stack([leaf.detach() for leaf in leaves]), atol=1e-6, rtol=1e-5)


def test_fit_takes_minibatches_in_the_order_of_its_indices():
    rows, seen = torch.arange(2 * 6, dtype=torch.float32).view(2, 6, 1).repeat(1, 1, 3), []
    net = make_net(torch.zeros(2, 16), (2, 1))

    def output_gradient(output, targets):
        seen.append(targets.clone())
        return torch.zeros_like(output)

    indices = torch.tensor([[0, 5, 2, 1, 3], [4, 4, 0, 1, 2]])
    gpo_ppo.fit(net, rows, output_gradient, indices, 2, lambda: None)
    assert [batch.shape[2] for batch in seen] == [2, 2, 1]
    assert torch.cat(seen, dim=2)[:, 0].tolist() == [[0, 5, 2, 1, 3], [10, 10, 6, 7, 8]]


def test_shuffles_are_permutations_per_epoch():
    orders = gpo_ppo.shuffles(generators(2), 7, 3, "cpu")
    assert orders.shape == (2, 21)
    assert all(sorted(epoch.tolist()) == list(range(7)) for row in orders for epoch in row.view(3, 7))
    assert len({tuple(epoch.tolist()) for row in orders for epoch in row.view(3, 7)}) == 6


# ---------------------------------------------------------------- Gaussian policies


def gaussians(seed, members=2, act_dim=3, samples=11):
    g = torch.Generator().manual_seed(seed)
    mean = torch.randn(members, act_dim, samples, dtype=torch.double, generator=g)
    return mean, 0.5 * torch.randn(members, act_dim, 1, dtype=torch.double, generator=g)


def torch_normal(mean, log_std):
    return Independent(Normal(mean.mT, log_std.exp().mT.expand_as(mean.mT)), 1)


def test_log_prob_is_that_of_torch_distributions():
    (mean, log_std), (actions, _) = gaussians(0), gaussians(1)
    ours = gpo_ppo.gaussian_log_prob(actions, mean, log_std)
    torch.testing.assert_close(ours, torch_normal(mean, log_std).log_prob(actions.mT))


def test_kl_and_its_direction_are_those_of_torch_distributions():
    p, q = gaussians(0), gaussians(1)
    forwards, backwards = gpo_ppo.gaussian_kl(*p, *q), gpo_ppo.gaussian_kl(*q, *p)
    torch.testing.assert_close(forwards, kl_divergence(torch_normal(*p), torch_normal(*q)))
    torch.testing.assert_close(backwards, kl_divergence(torch_normal(*q), torch_normal(*p)))
    assert (forwards - backwards).abs().max() > 0.1


def test_the_direction_of_each_kl_that_the_algorithm_uses(make_args):
    args = make_args()
    flat = random_stack(gpo_ppo.policy_sizes(args), 2, log_std=True)
    batch = sampled_batch(args, flat[0], seed=3)
    obs = batch.obs[0].T
    old, new = (reference_policy(row, args, obs) for row in flat)
    old_to_new = kl_divergence(old, new).mean().item()
    assert abs(old_to_new - kl_divergence(new, old).mean().item()) > 1e-2
    assert gpo_ppo.policy_kl(make_policy(flat[1:], args), batch) == pytest.approx(old_to_new)  # PPO's: KL[old, new]
    row = gpo_ppo.kl_row(make_policy(flat[:1], args), batch.obs, flat, args)  # S_i's: KL[pi_i, pi_j]
    np.testing.assert_allclose(row, [0, old_to_new], atol=1e-12)


def test_normalize_uses_each_members_statistics_and_clips():
    stats = SimpleNamespace(mean=np.array([[1.0, 2], [0, 0]]), inv_std=np.array([[0.5, 1], [100, 1]]))
    out = gpo_ppo.normalize(np.array([[[3.0, 2]], [[1, -11]]]), stats)
    np.testing.assert_array_equal(out, [[[1, 0]], [[10, -10]]])


def test_sampled_actions_are_mean_plus_std_times_noise(make_args):
    args = make_args()
    flat = random_stack(gpo_ppo.policy_sizes(args), 2, log_std=True)
    stats = SimpleNamespace(mean=np.random.default_rng(0).normal(size=(2, 5)), inv_std=np.full((2, 5), 0.7))
    obs, noise = np.random.default_rng(1).normal(size=(6, 5)), np.random.default_rng(2).normal(size=(4, 2, 3, 2))
    act = gpo_ppo.sample_actions(make_policy(flat, args), stats, noise)
    mean_act = gpo_ppo.sample_actions(make_policy(flat, args), stats, None)
    for e in range(6):  # members own three environments each, in a row
        i, seen = e // 3, torch.from_numpy((obs[e : e + 1] - stats.mean[e // 3]) * 0.7)
        policy = reference_policy(flat[i], args, seen)
        expected = policy.mean[0] + policy.stddev[0] * torch.from_numpy(noise[3, i, e % 3])
        np.testing.assert_allclose(act(obs, 3)[e], expected, rtol=1e-6)
        np.testing.assert_allclose(mean_act(obs, 3)[e], policy.mean[0], rtol=1e-6)


# ---------------------------------------------------------------- mutate


def random_rollout(seed, steps=23, envs=3, obs_dim=2, ends=0.15):
    g = np.random.default_rng(seed)
    data = SimpleNamespace(
        obs=g.normal(size=(steps, envs, obs_dim)).astype(np.float32),
        rewards=g.normal(size=(steps, envs)),
        terminations=g.random((steps, envs)) < ends,
        truncations=g.random((steps, envs)) < ends,
    )
    data.dones = data.terminations | data.truncations
    return data


def test_rollout_equals_stepping_gymnasiums_own_environments(line_args):
    """Successors at the ends of episodes are the final observations; actions are clipped for the environment only."""
    line_args.max_episode_steps = 16
    envs, seeds = gpo_ppo.make_envs(line_args, 3), [1, 2, 3]
    obs, _ = envs.reset(seed=seeds)
    played = np.random.default_rng(0).normal(0, 2, (40, 3, 1)).astype(np.float32)
    played[:, 2] = 1.5  # runs away to the right and terminates
    data = gpo_ppo.rollout(envs, obs.reshape(3, -1), lambda seen, t: played[t], 40)
    for e, seed in enumerate(seeds):
        env = gpo_ppo.gym.make("gpo_test/Line-v0", max_episode_steps=16)
        obs, _ = env.reset(seed=seed)
        for t in range(40):
            np.testing.assert_allclose(data.obs[t, e], obs.reshape(-1), rtol=1e-6)
            obs, reward, terminated, truncated, _ = env.step(np.clip(played[t, e : e + 1], -1, 1))
            np.testing.assert_allclose(data.next_obs[t, e], obs.reshape(-1), rtol=1e-6)
            facts = data.rewards[t, e], data.terminations[t, e], data.truncations[t, e], data.dones[t, e]
            assert facts == (pytest.approx(reward), terminated, truncated, terminated or truncated)
            if terminated or truncated:
                obs, _ = env.reset()
        np.testing.assert_allclose(data.last_obs[e].reshape(-1), obs.reshape(-1), rtol=1e-6)
    np.testing.assert_array_equal(data.actions, played)
    assert data.terminations.any() and data.truncations.any() and not data.diverged.any()


@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
def test_gae_is_the_sum_of_discounted_errors_of_an_episode(gae_lambda):
    gamma, data, g = 0.9, random_rollout(5), np.random.default_rng(6)
    assert (data.terminations & ~data.truncations).any() and (data.truncations & ~data.terminations).any()
    values, next_values = g.normal(size=(2, *data.rewards.shape))
    ours = gpo_ppo.generalized_advantages(data.rewards, values, next_values, data.terminations, data.dones, gamma, gae_lambda)
    steps, envs = data.rewards.shape
    for e in range(envs):
        for t in range(steps):
            total = 0.0
            for k in range(t, steps):  # to the end of the episode, or of the roll-out
                bootstrap = 0.0 if data.terminations[k, e] else next_values[k, e]
                delta = data.rewards[k, e] + gamma * bootstrap - values[k, e]
                total += (gamma * gae_lambda) ** (k - t) * delta
                if data.terminations[k, e] or data.truncations[k, e]:
                    break
            assert ours[t, e] == pytest.approx(total, abs=1e-10)


def test_make_batches_against_a_loop_over_members_and_environments(make_args):
    """Values, next values at truncations, advantages, log-probabilities, each at its own sample and member."""
    args, members, envs = make_args(num_steps=6), 3, 2
    data = random_rollout(8, steps=6, envs=members * envs, obs_dim=5, ends=0.2)
    g = np.random.default_rng(9)
    data.next_obs = g.normal(size=data.obs.shape).astype(np.float32)
    data.actions = g.normal(size=(6, members * envs, 2)).astype(np.float32)
    policies = random_stack(gpo_ppo.policy_sizes(args), members, log_std=True).float()
    critics = random_stack(gpo_ppo.critic_sizes(args), members, seed=1).float()
    stats = SimpleNamespace(
        mean=g.normal(size=(members, 5)).astype(np.float32),
        inv_std=g.uniform(0.5, 2, (members, 5)).astype(np.float32),
        return_rms=np.array([2.0, 3.0, 4.0]),
    )
    policy, critic = make_policy(policies, args), make_net(critics, gpo_ppo.critic_sizes(args))
    batches, (obs, values, returns, advantages) = gpo_ppo.make_batches(args, data, policy, critic, stats)

    def value(i, x):
        return reference_mlp(critics[i], gpo_ppo.critic_sizes(args), see(i, x))[0][..., 0].numpy() * stats.return_rms[i]

    def see(i, x):
        return torch.from_numpy((x - stats.mean[i]) * stats.inv_std[i])

    for i in range(members):
        columns = slice(i * envs, (i + 1) * envs)
        expected = gpo_ppo.generalized_advantages(
            *(data.rewards[:, columns], value(i, data.obs[:, columns]), value(i, data.next_obs[:, columns])),
            *(data.terminations[:, columns], data.dones[:, columns], args.gamma, args.gae_lambda),
        )
        np.testing.assert_allclose(advantages[i], expected.reshape(-1), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(values[i], value(i, data.obs[:, columns]).reshape(-1), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(returns[i], values[i] + advantages[i], rtol=1e-6)
        seen = see(i, data.obs[:, columns].reshape(-1, 5))
        torch.testing.assert_close(obs[i], seen)
        torch.testing.assert_close(batches[i].obs[0].T, seen)
        actions = torch.from_numpy(data.actions[:, columns].reshape(-1, 2))
        torch.testing.assert_close(batches[i].actions[0].T, actions)
        acting = reference_policy(policies[i], args, seen)
        torch.testing.assert_close(batches[i].log_probs[0], acting.log_prob(actions), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(batches[i].mean[0].T, acting.mean, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("norm_adv", [True, False])
def test_advantages_are_normalized_over_each_members_batch(make_args, norm_adv):
    raw = np.random.default_rng(0).normal(3, 5, (2, 50)) * [[1], [10]]
    batches = [SimpleNamespace(obs=torch.zeros(1)) for _ in raw]
    gpo_ppo.set_advantages(make_args(norm_adv=norm_adv), batches, raw, raw)
    for batch, own in zip(batches, raw):
        expected = (own - own.mean()) / own.std() if norm_adv else own
        np.testing.assert_allclose(batch.advantages[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kl_hinge", [0.0, 100.0])
@pytest.mark.parametrize("clip", [math.inf, 1.0, 0.8])
@pytest.mark.parametrize("borrow", [0, 2])
def test_shared_gradient_is_autograds_of_the_sum_of_losses(make_args, borrow, clip, kl_hinge):
    args = make_args(kl_hinge=kl_hinge)
    acting = random_stack(gpo_ppo.policy_sizes(args), 3, log_std=True)
    batches = [sampled_batch(args, row, seed) for seed, row in enumerate(acting)][: 1 + borrow]
    generator = torch.Generator().manual_seed(7)  # pi_i after some gradient steps: no longer the policy that acted
    now = acting[0] + 0.05 * torch.randn(acting[0].shape, dtype=torch.double, generator=generator)
    policy = make_policy(now[None].clone(), args)
    kl = gpo_ppo.policy_kl(policy, batches[0])
    assert kl > 2 * args.kl_target  # the hinge is active
    gpo_ppo.ppo_gradient(policy, batches, gpo_ppo.ppo_penalty(args, 0.7, kl), clip)
    expected = autograd(lambda row: reference_loss(args, row, batches, 0.7, kl_hinge, clip), now)
    torch.testing.assert_close(policy.grad[0], expected, atol=1e-9, rtol=1e-7)


def test_reported_loss_is_minus_the_surrogate(make_args):
    args = make_args()
    acting = random_stack(gpo_ppo.policy_sizes(args), 3, log_std=True)
    batches = [sampled_batch(args, row, seed) for seed, row in enumerate(acting)]
    loss = gpo_ppo.ppo_gradient(make_policy(acting[:1].clone(), args), batches, 0.7)  # the policy that acted: its KL is 0
    assert loss == pytest.approx(reference_loss(args, acting[0], batches, 0.7, 0, math.inf).item())


def test_own_samples_are_never_capped_and_the_cap_matters(make_args):
    args = make_args()
    acting = random_stack(gpo_ppo.policy_sizes(args), 2, log_std=True)
    own, other = (sampled_batch(args, row, seed) for seed, row in enumerate(acting))

    def gradient(batches, clip):
        policy = make_policy(acting[:1] + 0.05, args)
        gpo_ppo.ppo_gradient(policy, batches, 1.0, clip)
        return policy.grad

    assert torch.equal(gradient([own], 0.5), gradient([own], math.inf))
    assert (gradient([own, other], 0.5) - gradient([own, other], math.inf)).abs().max() > 1e-2


@pytest.mark.parametrize("kl_hinge, clip", [(100.0, 1.0), (0.0, math.inf)])
def test_stacked_ppo_update_is_autograd_and_torchs_adam_member_by_member(make_args, kl_hinge, clip):
    args = make_args(kl_hinge=kl_hinge, importance_clip=clip, learning_rate=1e-2)
    start = random_stack(gpo_ppo.policy_sizes(args), 3, log_std=True)
    batches = [sampled_batch(args, row, seed) for seed, row in enumerate(start)]
    borrowed = [[batches[1], batches[2]], [], [batches[0]]]
    policy, kl_coefs = make_policy(start.clone(), args), torch.tensor([1.0, 2.0, 3.0], dtype=torch.double)
    gpo_ppo.adam(policy)
    _, kls = gpo_ppo.ppo_update(args, policy, batches, borrowed, kl_coefs)
    for i in range(3):
        row = start[i].clone().requires_grad_()
        optimizer = torch.optim.Adam([row], lr=args.learning_rate, eps=1e-5)
        for _ in range(args.update_epochs):
            with torch.enable_grad():
                optimizer.zero_grad()
                reference_loss(args, row, [batches[i], *borrowed[i]], i + 1.0, kl_hinge, clip).backward()
            optimizer.step()
        torch.testing.assert_close(policy.flat[i], row.detach(), atol=1e-6, rtol=1e-6)
        old = Independent(Normal(batches[i].mean[0].T, batches[i].log_std[0].T.exp()), 1)
        kl = kl_divergence(old, reference_policy(row.detach(), args, batches[i].obs[0].T)).mean().item()
        assert kls[i] == pytest.approx(kl, rel=1e-4)
        factor = 2 if kl > 1.5 * args.kl_target else 0.5 if kl < args.kl_target / 1.5 else 1
        assert kl_coefs[i] == (i + 1) * factor


def test_stacked_updates_equal_those_of_members_alone_to_the_bit(make_args):
    """Policies and critics, of which one worker may own any number."""
    args = make_args(critic_epochs=2, critic_minibatch_size=16)
    start = random_stack(gpo_ppo.policy_sizes(args), 3, log_std=True).float()
    critics = random_stack(gpo_ppo.critic_sizes(args), 3, seed=1).float()
    batches = [sampled_batch(args, row, seed) for seed, row in enumerate(start)]
    obs, targets = torch.cat([batch.obs.mT for batch in batches]), np.random.default_rng(0).normal(size=(3, 40))

    def update(members):
        policy = make_policy(start[members].clone(), args)
        critic = make_net(critics[members].clone(), gpo_ppo.critic_sizes(args))
        for net in (policy, critic):
            gpo_ppo.adam(net)
        own = [batches[i] for i in members]
        borrowed = [[batches[j] for j in range(3) if j != i] for i in members]
        gpo_ppo.ppo_update(args, policy, own, borrowed, torch.ones(len(members), dtype=torch.double))
        gpo_ppo.update_critics(args, critic, obs[members], targets[members], [generators(3)[i] for i in members])
        return torch.cat([policy.flat, critic.flat], dim=1)

    together = update([0, 1, 2])
    assert not torch.equal(together, torch.cat([start, critics], dim=1))
    for i in range(3):
        assert torch.equal(update([i])[0], together[i])
    assert torch.equal(update([1, 2]), together[1:])


def test_critic_update_is_torchs_adam_on_the_squared_error(make_args):
    args = make_args(critic_epochs=2, critic_minibatch_size=16, critic_learning_rate=1e-2)
    sizes = gpo_ppo.critic_sizes(args)
    start = random_stack(sizes, 2)
    obs, targets = torch.randn(2, 40, 5, dtype=torch.double), np.random.default_rng(0).normal(size=(2, 40))
    critic = make_net(start.clone(), sizes)
    gpo_ppo.adam(critic)
    gpo_ppo.update_critics(args, critic, obs, targets, generators(2))
    targets = torch.from_numpy(targets.astype(np.float32)).double()
    orders = gpo_ppo.shuffles(generators(2), 40, 2, "cpu")
    for i in range(2):
        row = start[i].clone().requires_grad_()
        optimizer = torch.optim.Adam([row], lr=1e-2, eps=1e-5)
        for chunk in orders[i].split(16):
            with torch.enable_grad():
                optimizer.zero_grad()
                (0.5 * (reference_mlp(row, sizes, obs[i, chunk])[0][:, 0] - targets[i, chunk]).square().mean()).backward()
            optimizer.step()
        torch.testing.assert_close(critic.flat[i], row.detach(), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    "kl, before, after", [(0.02, 1, 2), (0.015, 1, 1), (0.007, 1, 1), (0.006, 1, 0.5), (1, 1e4, 1e4), (0, 1e-4, 1e-4)]
)
def test_kl_coef_doubles_and_halves_outside_a_factor_of_one_and_a_half(make_args, kl, before, after):
    assert gpo_ppo.adapt_kl_coef(make_args(kl_target=0.01), before, kl) == after


def assert_identity(stats):
    for values, neutral in ((stats.mean, 0), (stats.inv_std, 1), (stats.return_rms, 1)):
        np.testing.assert_allclose(values, np.full_like(values, neutral), rtol=1e-7)


def test_statistics_equal_numpys_over_all_data_of_all_members(make_args):
    args, n, g = make_args(), 3, np.random.default_rng(0)
    population = gpo_ppo.new_population(args, list(range(n)))
    stats = gpo_ppo.statistics(population)
    assert_identity(stats)  # before the first data
    seen, square, weight = [], 0.0, 0.0
    for iteration in range(25):
        obs = [g.normal(50 * i, 1 + iteration, (40, 5)).astype(np.float32) for i in range(n)]
        returns = [g.normal(7, 30, 40) for _ in range(n)]
        moments = [gpo_ppo.batch_moments(o, r) for o, r in zip(obs, returns)]
        for i in range(n):
            gpo_ppo.update_statistics(args, population, i, moments)
        seen += obs
        square, weight = 0.95 * square + np.mean(np.square(returns)), 0.95 * weight + 1
    stats, everything = gpo_ppo.statistics(population), np.concatenate(seen).astype(np.float64)
    np.testing.assert_allclose(stats.mean, np.tile(everything.mean(0), (n, 1)), rtol=1e-6)
    np.testing.assert_allclose(stats.inv_std, np.tile(1 / everything.std(0), (n, 1)), rtol=1e-6)
    np.testing.assert_allclose(stats.return_rms, np.full(n, math.sqrt(square / weight)), rtol=1e-6)


def test_statistics_leave_out_a_broken_members_batch(make_args):
    args, g = make_args(), np.random.default_rng(0)
    good = [gpo_ppo.batch_moments(g.normal(3, 2, (40, 5)), g.normal(size=40)) for _ in range(2)]
    bad_obs = gpo_ppo.batch_moments(np.full((40, 5), NAN), np.ones(40))
    bad_returns = gpo_ppo.batch_moments(np.ones((40, 5)), np.full(40, math.inf))
    populations = [gpo_ppo.new_population(args, [0]) for _ in range(3)]
    for population, moments in zip(populations, (good, [bad_obs, good[0], bad_returns, good[1]], [bad_obs, bad_returns])):
        gpo_ppo.update_statistics(args, population, 0, moments)
    expected, spared, untouched = map(gpo_ppo.statistics, populations)
    for name in vars(expected):
        np.testing.assert_array_equal(getattr(spared, name), getattr(expected, name))
    assert_identity(untouched)


def test_statistics_that_are_switched_off_stay_the_identity(make_args):
    args = make_args(norm_obs=False, norm_returns=False)
    population = gpo_ppo.new_population(args, [0])
    gpo_ppo.update_statistics(args, population, 0, [gpo_ppo.batch_moments(np.full((9, 5), 3.0), np.full(9, 50.0))])
    assert_identity(gpo_ppo.statistics(population))


def test_similar_members_are_those_below_the_threshold_without_itself(make_args):
    rows = random_stack((5, 64, 64, 2), 1, log_std=True).repeat(4, 1)
    args = make_args(population=4)
    nets = make_policy(rows, args)
    batches = [sampled_batch(args, row, seed=0) for row in rows]
    nets.log_std.copy_(torch.tensor([0.0, 0.3, 2.0, NAN])[:, None, None])
    kl = np.array([gpo_ppo.kl_row(row, batch.obs, rows, args) for row, batch in zip(nets.rows, batches)])
    assert kl[0, 1] != kl[1, 0]
    for threshold in (0.0, kl[0, 1], (kl[0, 1] + kl[1, 0]) / 2, 1e9):
        args.kl_sharing_threshold = threshold
        similar = gpo_ppo.similar_members(args, SimpleNamespace(policies=rows), nets, batches, [0, 1, 2, 3])
        for i in range(4):
            assert similar[i] == [j for j in range(4) if j != i and kl[i, j] < threshold]
    assert similar == [[1, 2], [0, 2], [0, 1], []]  # nobody borrows from the broken one, nor it from others
    args.data_sharing = False
    assert gpo_ppo.similar_members(args, None, nets, batches, [0, 1, 2, 3]) == [[]] * 4


def test_finished_episodes_against_a_slow_loop_over_several_rollouts():
    opened, current = [[] for _ in range(3)], [[] for _ in range(3)]
    for seed in range(6):
        data = random_rollout(seed, steps=9, ends=[0, 0.1, 0.05, 0.5, 0, 0.1][seed])
        expected = [[] for _ in range(3)]
        for t in range(9):
            for e in range(3):
                current[e].append((data.obs[t, e], data.rewards[t, e]))
                if data.dones[t, e]:
                    expected[e].append(current[e])
                    current[e] = []
        finished = gpo_ppo.finished_episodes(opened, data)
        assert [len(episodes) for episodes in finished] == [len(episodes) for episodes in expected]
        for episode, reference in zip(sum(finished, []), sum(expected, [])):
            np.testing.assert_array_equal(episode[0], [obs for obs, _ in reference])
            assert episode[1] == pytest.approx(sum(reward for _, reward in reference))
    assert sum(map(len, current)) == sum(len(obs) for pieces in opened for obs, _ in pieces)


def test_remember_keeps_the_most_recent_transitions(make_args):
    args, pool, recent = make_args(crossover_pool=10), gpo_ppo.deque(), gpo_ppo.deque(maxlen=2)
    for k, length in enumerate([6, 4, 3, 30, 2]):
        gpo_ppo.remember(args, pool, recent, [(np.zeros((length, 1)), float(k))])
        kept = [ret for _, ret in pool]
        assert kept == [[0], [0, 1], [0, 1, 2], [3], [3, 4]][k]  # as few of the last as make up 10, whole episodes
    assert list(recent) == [[3.0], [4.0]]


# ---------------------------------------------------------------- select


@pytest.mark.parametrize("m", [2, 3, 8])
def test_select_takes_the_m_fittest_of_all_couples(make_args, m):
    args, fitness = make_args(), np.random.default_rng(m).normal(size=m)
    couples = gpo_ppo.select(args, 0, fitness, np.zeros((m, m)))
    everyone = sorted(combinations(range(m), 2), key=lambda couple: -fitness[couple[0]] - fitness[couple[1]])
    expected = everyone[:m] if m > 2 else [(0, 1), (0, 1)]
    assert [tuple(couple) for couple in couples] == expected


def test_select_breaks_ties_by_index(make_args):
    assert gpo_ppo.select(make_args(), 0, np.ones(4), np.zeros((4, 4))) == [(0, 1), (0, 2), (0, 3), (1, 2)]
    assert gpo_ppo.select(make_args(), 0, np.array([0.0, 5, 0, 5]), np.zeros((4, 4))) == [(1, 3), (0, 1), (0, 3), (1, 2)]


@pytest.mark.parametrize("selection", ["fitness", "random"])
@pytest.mark.parametrize("broken", [NAN, math.inf, -math.inf])
def test_broken_members_are_in_no_couple_and_few_couples_are_used_again(make_args, broken, selection):
    args = make_args(selection=selection)
    couples = gpo_ppo.select(args, 0, np.array([1.0, broken, 3.0, broken, 2.0]), np.zeros((5, 5)))
    assert len(couples) == 5 and set(couples) == {(0, 2), (2, 4), (0, 4)}
    if selection == "fitness":
        assert couples == [(2, 4), (0, 2), (0, 4), (2, 4), (0, 2)]
    assert gpo_ppo.select(args, 0, np.array([broken, 1.0, 2.0]), np.zeros((3, 3))) == [(1, 2)] * 3


def test_one_healthy_member_is_paired_with_itself_and_none_is_an_error(make_args):
    assert gpo_ppo.select(make_args(), 0, np.array([NAN, -7.0, NAN]), np.zeros((3, 3))) == [(1, 1)] * 3
    with pytest.raises(RuntimeError, match="finite"):
        gpo_ppo.select(make_args(), 0, np.full(3, NAN), np.zeros((3, 3)))


def test_random_selection_ignores_fitness_and_depends_on_seed_and_round(make_args):
    def couples(fitness=None, seed=1, generation=0):
        args, fitness = make_args(selection="random", seed=seed), np.arange(8.0) if fitness is None else fitness
        return gpo_ppo.select(args, generation, fitness, np.zeros((8, 8)))

    first = couples()
    assert len(set(first)) == 8 and all(x < y for x, y in first)
    assert first == couples(fitness=-np.arange(8.0))
    assert len({tuple(couples(seed=s, generation=k)) for s in (1, 2) for k in (0, 1)}) == 4
    seen = {couple for seed in range(60) for couple in couples(seed=seed)}
    assert seen == set(combinations(range(8), 2))


def test_diversity_is_the_symmetrized_kl(make_args):
    kl = np.array([[0, 5, 1], [0, 0, 1], [1, 6, 0]], dtype=float)  # sums: (0, 1) 5, (0, 2) 2, (1, 2) 7
    couples = gpo_ppo.select(make_args(fitness="diversity"), 0, np.array([9.0, 0, 9]), kl)
    assert couples == [(1, 2), (0, 1), (0, 2)]


def test_mixture_is_annealed_from_the_given_weight_to_performance(make_args):
    g = np.random.default_rng(0)
    fitness, kl, couples = g.normal(size=6) * 100, g.random((6, 6)), list(combinations(range(6), 2))
    performance = np.array([fitness[x] + fitness[y] for x, y in couples])
    diversity = np.array([kl[x, y] + kl[y, x] for x, y in couples])
    args = make_args(fitness="mixture", diversity_weight=0.8, plan=[1] * 5)
    for generation, weight in enumerate([0.8, 0.6, 0.4, 0.2, 0.0]):
        expected = (1 - weight) * (performance - performance.mean()) / performance.std()
        expected += weight * (diversity - diversity.mean()) / diversity.std()
        ours = gpo_ppo.couple_fitness(args, generation, couples, fitness, kl)
        np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-7)
    args.plan = [1]
    assert np.isfinite(gpo_ppo.couple_fitness(args, 0, couples, fitness, kl)).all()


@pytest.mark.parametrize(
    "pool, recent, open_pieces, expected",
    [
        ([1.0, 2.0, 6.0], [[2.0], [6.0]], [], 4.0),  # the last two iterations
        ([1.0, 2.0], [[], []], [], 2.0),  # the last that ended
        ([], [[], []], [[(np.zeros((2, 1)), 3.0), (np.zeros((2, 1)), 4.0)], [(np.zeros((3, 1)), 1.0)]], 4.0),  # the open ones
    ],
)
@pytest.mark.parametrize("flaw", [None, "diverged", "policy", "critic"])
def test_member_fitness(make_args, pool, recent, open_pieces, expected, flaw):
    args = make_args(num_envs=2)
    members = SimpleNamespace(
        policy=make_policy(random_stack(gpo_ppo.policy_sizes(args), 1, log_std=True), args),
        critic=make_net(random_stack(gpo_ppo.critic_sizes(args), 1), gpo_ppo.critic_sizes(args)),
        open_episodes=open_pieces,
        diverged=[flaw == "diverged"],
    )
    if flaw in ("policy", "critic"):
        getattr(members, flaw).flat[0, 3] = NAN
    pools = [gpo_ppo.deque((np.zeros((2, 1)), ret) for ret in pool)]
    fitness = gpo_ppo.member_fitness(args, members, pools, [gpo_ppo.deque(recent, maxlen=2)], 0)
    assert math.isnan(fitness) if flaw else fitness == expected
    assert pools[0]  # pi_S has something to learn from


# ---------------------------------------------------------------- crossover


IDENTITY = SimpleNamespace(mean=np.zeros((1, 2), np.float32), inv_std=np.ones((1, 2), np.float32))


def trajectory(center, ret, length=40, seed=0):
    return np.random.default_rng([seed, int(100 * abs(center)), length]).normal(center, 0.3, (length, 2)), ret


def test_selector_data_keeps_the_best_of_both_parents_weighted_by_return(make_args):
    args = make_args(obs_dim=2, crossover_top=0.6)
    x = [trajectory(1, 10.0, 3), trajectory(1, -2.0, 4)]
    y = [trajectory(-1, 6.0, 5), trajectory(-1, 4.0, 6), trajectory(-1, 2.0, 7)]
    rows = gpo_ppo.selector_data(args, {4: x, 7: y}, (4, 7), IDENTITY)
    weights = [(1.1, 0)] * 3 + [(0, 0.1 + 2 / 6)] * 5 + [(0, 0.1)] * 6  # 3 of 5 trajectories: 10, 6 and 4
    mean = sum(map(sum, weights)) / len(weights)
    np.testing.assert_allclose(rows[:, :2], np.concatenate([x[0][0], y[0][0], y[1][0]]), rtol=1e-6)
    np.testing.assert_allclose(rows[:, 2:], np.array(weights) / mean, rtol=1e-5)


def test_equal_returns_weigh_equally(make_args):
    args = make_args(obs_dim=2, crossover_top=1.0)
    rows = gpo_ppo.selector_data(args, [[trajectory(1, 5.0)], [trajectory(-1, 5.0)]], (0, 1), IDENTITY)
    np.testing.assert_allclose(rows[:40, 2:], [[1, 0]] * 40)
    np.testing.assert_allclose(rows[40:, 2:], [[0, 1]] * 40)


@pytest.fixture
def gradients(monkeypatch):
    """Instead of Adam's steps: the gradients with which they were called."""
    recorded = []
    monkeypatch.setattr(gpo_ppo, "adam_step", lambda net, rate: recorded.append((net.flat.clone(), net.grad.clone(), rate)))
    return recorded


def test_selector_gradient_is_autograds_of_the_weighted_log_likelihood(make_args, gradients):
    args, g = make_args(crossover_minibatch_size=30), np.random.default_rng(0)
    rows = []
    for _ in range(2):
        row = g.normal(size=(30, 7)).astype(np.float32)
        row[:, 5:] = np.where(g.random((30, 1)) < 0.4, [1, 0], [0, 1]) * g.random((30, 1))
        rows.append(row)
    gpo_ppo.train_selector(args, 0, [0, 1], rows, 1, "cpu")
    ((flat, grad, rate),) = gradients
    assert rate == args.crossover_learning_rate
    for i, row in enumerate(map(torch.from_numpy, rows)):

        def loss(leaf, row=row):
            logits, _ = reference_mlp(leaf, (5, 32, 32, 2), row[:, :5])
            return -(row[:, 5:] * torch.log_softmax(logits, 1)).sum(1).mean()

        torch.testing.assert_close(grad[i], autograd(loss, flat[i]), atol=1e-6, rtol=1e-4)


def test_distillation_gradient_is_autograds_of_the_kl_from_child_to_expert(make_args, gradients, monkeypatch):
    args = make_args(dagger_iterations=0, dagger_epochs=1, crossover_minibatch_size=30)
    children = random_stack(gpo_ppo.policy_sizes(args), 2, log_std=True).float()
    generator = torch.Generator().manual_seed(3)
    rows = torch.randn(2, 30, 5 + 2 * 2, generator=generator) * torch.tensor([1.0] * 5 + [1, 1, 0.3, 0.3])
    monkeypatch.setattr(gpo_ppo, "dagger_rollout", lambda *_: (rows, np.zeros(2)))
    parents = [make_policy(random_stack(gpo_ppo.policy_sizes(args), 2, s, log_std=True).float(), args) for s in (1, 2)]
    (facts, *_) = [gpo_ppo.distill(args, 0, [0, 1], make_policy(children.clone(), args), None, parents, None)]
    ((_, grad, rate),) = gradients
    assert rate == args.crossover_learning_rate
    for i in range(2):
        obs, mean, log_std = rows[i].split([5, 2, 2], dim=1)
        expert = Independent(Normal(mean, log_std.exp()), 1)

        def loss(leaf, expert=expert, obs=obs):
            return kl_divergence(reference_policy(leaf, args, obs), expert).mean()

        torch.testing.assert_close(grad[i], autograd(loss, children[i]), atol=1e-5, rtol=1e-4)
        assert facts[i]["distillation_kl"] == pytest.approx(loss(children[i]).item(), rel=1e-4)
        for parent, kl in zip(parents, facts[i]["kl_to_parents"]):
            policy = reference_policy(parent.flat[i], args, obs)
            expected = kl_divergence(reference_policy(children[i], args, obs), policy).mean().item()
            assert kl == pytest.approx(expected, rel=1e-4)


def test_selector_tells_two_separable_parents_apart(make_args):
    args = make_args(obs_dim=2, pi_s_epochs=100)
    pools = [[trajectory(1, 5.0 + k, seed=k) for k in range(5)] for _ in "xy"]
    pools[1] = [(-obs, ret) for obs, ret in pools[1]]
    rows = gpo_ppo.selector_data(args, pools, (0, 1), IDENTITY)
    pi_s = gpo_ppo.train_selector(args, 0, [0], [rows], args.pi_s_epochs * math.ceil(len(rows) / 64), "cpu")
    for center, parent in ((1, 0), (-1, 1)):
        obs = np.random.default_rng(99).normal(center, 0.3, (1, 500, 2)).astype(np.float32)
        says = torch.softmax(torch.from_numpy(gpo_ppo.net_output(pi_s, obs)), 2)[0, :, parent]
        assert (says > 0.5).float().mean() > 0.99 and says.mean() > 0.9


def test_selector_prefers_the_parent_with_better_returns_where_both_have_been(make_args):
    """On equal observations the likelihood's optimum is each parent's share of the weight."""
    args, obs = make_args(obs_dim=2, crossover_top=1.0), trajectory(0, 0.0, 400)[0]
    pools = [[(obs, 8.0)], [(obs, 0.0), (obs, 0.0)]]  # weights 1.1 against 0.1 + 0.1
    rows = gpo_ppo.selector_data(args, pools, (0, 1), IDENTITY)
    pi_s = gpo_ppo.train_selector(args, 0, [0], [rows], 600, "cpu")
    logits = torch.from_numpy(gpo_ppo.net_output(pi_s, obs[None].astype(np.float32)))
    assert torch.softmax(logits, 2)[..., 0].mean().item() == pytest.approx(1.1 / 1.3, abs=0.03)


def test_stacked_selectors_equal_those_alone_to_the_bit(make_args):
    args, g = make_args(obs_dim=2), np.random.default_rng(0)
    rows = [g.random((n, 4)).astype(np.float32) for n in (100, 230, 64)]
    together = gpo_ppo.train_selector(args, 2, [3, 4, 5], rows, 12, "cpu").flat
    for k in range(3):
        assert torch.equal(gpo_ppo.train_selector(args, 2, [3 + k], rows[k : k + 1], 12, "cpu").flat[0], together[k])


def test_expert_draws_the_parent_from_the_selector(make_args):
    args = make_args()
    pi_s = make_net(random_stack((5, 32, 32, 2), 2).float(), (5, 32, 32, 2))
    parents = [make_policy(random_stack(gpo_ppo.policy_sizes(args), 2, s, log_std=True).float(), args) for s in (1, 2)]
    g = np.random.default_rng(0)
    obs, uniform = np.repeat(g.normal(size=(2, 1, 5)).astype(np.float32), 20000, axis=1), g.random((2, 20000))
    targets = gpo_ppo.expert_targets(pi_s, parents, obs, uniform)
    for i in range(2):
        state = torch.from_numpy(obs[i, :1])
        options = [reference_policy(parent.flat[i], args, state) for parent in parents]
        options = [np.concatenate([p.mean[0], p.stddev[0].log()]) for p in options]
        is_x, is_y = (np.isclose(targets[i], option, atol=1e-4).all(1) for option in options)
        assert (is_x ^ is_y).all()
        p_x = torch.softmax(reference_mlp(pi_s.flat[i], (5, 32, 32, 2), state)[0], 1)[0, 0].item()
        assert 0.05 < p_x < 0.95 and is_x.mean() == pytest.approx(p_x, abs=0.02)


# ---------------------------------------------------------------- crossover on Line: what each parent can do is known


def line_policy(args, slope_right, slope_left, std=0.1):
    """A hand-made policy of Line: mean action -slope * x, with a slope for each side of 0."""
    rows = torch.zeros_like(gpo_ppo.init_rows(generators(1), gpo_ppo.policy_sizes(args), 0.0, log_std=True))
    net = make_policy(rows, args)
    (W1, b1, *_), (W2, _, *_), (W3, b3, *_) = net.layers
    # Steps at either side of 0, each by 32 equal units.
    W1[0, :32, 0], b1[0, :32, 0], W1[0, 32:, 0], b1[0, 32:, 0] = 8, -1, 8, 1
    W2[0] = torch.eye(64)
    scale = math.tanh(1.0) * 32
    W3[0, 0, :32], W3[0, 0, 32:] = -slope_right / 2 / scale, -slope_left / 2 / scale
    b3[0, 0, 0] = (-slope_right + slope_left) / 2
    net.log_std.fill_(math.log(std))
    return rows[0]


@pytest.fixture
def line_args(make_args):
    return make_args(
        **dict(env_id="gpo_test/Line-v0", obs_dim=4, act_dim=1, max_episode_steps=32, seed=3, crossover_minibatch_size=64),
        **dict(expert_steps=1000, student_steps=200, dagger_iterations=5, dagger_epochs=10, pi_s_epochs=200),
    )


LINE_STATS = SimpleNamespace(mean=np.zeros((1, 4), np.float32), inv_std=np.ones((1, 4), np.float32), return_rms=np.ones(1))


def play(args, rows, episodes=40):
    stats = SimpleNamespace(**{name: np.repeat(x, len(rows), axis=0) for name, x in vars(LINE_STATS).items()})
    return gpo_ppo.evaluate(args, make_policy(rows, args), stats, "test", episodes)


def pools_of(args, rows, episodes=20):
    """Complete episodes of each policy, as (obs, return)."""
    pools = []
    for i, row in enumerate(rows):
        envs = gpo_ppo.make_envs(args, episodes)
        obs, _ = envs.reset(seed=list(range(100 * i, 100 * i + episodes)))
        noise = gpo_ppo.normal_noise(generators(1, i), 32, episodes, 1)
        act = gpo_ppo.sample_actions(make_policy(row[None], args), LINE_STATS, noise)
        data = gpo_ppo.rollout(envs, obs.reshape(episodes, -1), act, 32)
        pools.append(sum(gpo_ppo.finished_episodes([[] for _ in range(episodes)], data), []))
    return pools


def test_crossover_of_a_left_and_a_right_specialist_makes_a_child_better_than_both(line_args):
    right, left = line_policy(line_args, 1, 0), line_policy(line_args, 0, 1)  # each returns to 0 from one side only
    parents = torch.stack([right, left])
    line_args.crossover_top = 0.4  # about half of all episodes start on the good side
    returns = play(line_args, parents).mean(1)
    population = SimpleNamespace(policies=parents, fitness=returns)
    pools = pools_of(line_args, parents)
    children, facts, pi_s = gpo_ppo.crossover(line_args, 0, [0, 1], [(0, 1), (0, 1)], population, pools, LINE_STATS)
    child_returns = play(line_args, children).mean(1)
    both = play(line_args, line_policy(line_args, 1, 1)[None]).mean()
    assert both > returns.max() + 5  # on one side a specialist stays where it starts
    assert (child_returns > returns.max() + 0.7 * (both - returns.max())).all()
    for fact in facts:
        assert fact["pi_s_accuracy"] > 0.6 and 0.2 < fact["share_x"] < 0.8  # near 0 the parents cannot be told apart
    sides = np.array([[[x, 1, x / 2, -1] for x in (-0.9, -0.6, 0.6, 0.9)]] * 2, np.float32)
    logits = gpo_ppo.net_output(make_net(pi_s, (4, 32, 32, 2)), sides)
    assert (logits.argmax(2) == [1, 1, 0, 0]).all()
    assert not torch.equal(children[0], children[1])


def test_distillation_lowers_the_kl_to_the_expert_and_keeps_its_return(line_args):
    """Both parents are the same expert, the child starts as a fresh policy: plain DAgger."""
    expert, fresh = line_policy(line_args, 1, 1)[None], gpo_ppo.init_rows(generators(1), (4, 64, 64, 1), 0.01, log_std=True)
    pi_s = make_net(gpo_ppo.init_rows(generators(1), (4, 32, 32, 2), 0.01), (4, 32, 32, 2))
    parents = [make_policy(expert.clone(), line_args) for _ in range(2)]

    def distill(learning_rate):
        child = make_policy(fresh.clone(), line_args)
        line_args.crossover_learning_rate = learning_rate
        (fact,) = gpo_ppo.distill(line_args, 0, [0], child, pi_s, parents, LINE_STATS)
        return fact, play(line_args, child.flat).mean()

    (before, return_before), (after, return_after) = distill(1e-9), distill(2e-3)
    expert_return = play(line_args, expert).mean()
    assert after["distillation_kl"] < 0.05 * before["distillation_kl"]
    assert after["distillation_kl"] == pytest.approx(after["kl_to_parents"][0]) == after["kl_to_parents"][1]
    assert return_before < expert_return - 10
    assert return_after > expert_return - 1.5
    assert after["student_reward"] > before["student_reward"] + 0.3


def test_evaluation_plays_complete_episodes_of_the_given_number(line_args):
    """Line's return follows from its start and actions, so a loop over Gymnasium's own environment gives it."""
    rows = torch.stack([line_policy(line_args, 1, 1), line_policy(line_args, -3, -3)])  # the second runs away and terminates
    ours = play(line_args, rows, episodes=25)
    assert ours.shape == (2, 25)
    for chunk, width, episodes in ((0, 20, 20), (1, 20, 5)):
        noise = gpo_ppo.normal_noise([gpo_ppo.rng(3, "test", chunk, 1)], 32, width, 1)
        seeds = gpo_ppo.env_seeds(width, 3, "test", chunk)
        for i, row in enumerate(rows):
            for e in range(episodes):
                env = gpo_ppo.gym.make("gpo_test/Line-v0")
                obs, _ = env.reset(seed=seeds[e])
                total, done, t = 0.0, False, 0
                while not done:
                    policy = reference_policy(row, line_args, torch.from_numpy(obs.reshape(1, 4)).float())
                    action = policy.mean[0].numpy() + policy.stddev[0].numpy() * noise[t, 0, e]
                    obs, reward, terminated, truncated, _ = env.step(np.clip(action, -1, 1).reshape(1, 1))
                    total, done, t = total + reward, terminated or truncated, t + 1
                assert (t < 32) == (i == 1)
                assert ours[i, 20 * chunk + e] == pytest.approx(total, rel=1e-4)


def test_selection_and_report_episodes_are_disjoint(make_args):
    args = make_args()
    seeds = [gpo_ppo.env_seeds(20, args.seed, purpose, chunk) for purpose in ("selection", "report") for chunk in range(5)]
    assert len(set(sum(seeds, []))) == 200


def test_a_child_starts_as_a_copy_of_the_stronger_parent(make_args, monkeypatch):
    args, pools = make_args(obs_dim=2), [[trajectory(1, 1.0)], [trajectory(-1, 1.0)], [trajectory(2, 1.0)]]
    policies = random_stack(gpo_ppo.policy_sizes(args), 3, log_std=True).float()
    parents = SimpleNamespace(policies=policies, fitness=np.array([1.0, 5.0, 5.0]))
    monkeypatch.setattr(gpo_ppo, "distill", lambda args, generation, slots, *_: [{} for _ in slots])
    children, facts, pi_s = gpo_ppo.crossover(args, 0, [0, 1, 2], [(0, 1), (0, 2), (1, 2)], parents, pools, IDENTITY)
    assert torch.equal(children, policies[[1, 2, 1]])
    assert [fact["share_x"] for fact in facts] == [1.0] * 3  # one of two trajectories is kept, ties in the couple's order


@pytest.mark.parametrize("kind", ["copy", "parameter"])
def test_crossover_ablations(make_args, kind):
    args = make_args(crossover=kind)
    policies = random_stack(gpo_ppo.policy_sizes(args), 2, log_std=True).float()
    parents = SimpleNamespace(policies=policies, fitness=np.array([1.0, 5.0]))
    children, facts, pi_s = gpo_ppo.crossover(args, 0, [0, 1], [(0, 1), (0, 1)], parents, None, None)
    assert facts == [{}, {}] and pi_s is None and gpo_ppo.crossover_steps(args) == 0
    if kind == "copy":
        assert torch.equal(children, policies[[1, 1]])
    else:
        assert ((children == policies[0]) | (children == policies[1])).all()
        share = (children == policies[0]).float().mean(1)
        assert ((share > 0.47) & (share < 0.53)).all() and not torch.equal(children[0], children[1])
    assert torch.equal(parents.policies, policies)


# ---------------------------------------------------------------- the plan and randomness


def test_every_plan_meets_its_budget_to_less_than_an_iteration(make_args):
    g = np.random.default_rng(0)
    for _ in range(500):
        args = make_args(population=int(g.integers(2, 10)), rounds=int(g.integers(1, 15)), num_envs=int(g.integers(1, 5)))
        args.num_steps, args.expert_steps = int(g.integers(1, 600)), int(g.integers(10, 600))
        args.dagger_iterations, args.student_steps = int(g.integers(0, 5)), int(g.integers(1, 100))
        iteration = args.population * args.num_envs * args.num_steps
        crossovers = args.population * (args.expert_steps // 10 * 10 + args.dagger_iterations * args.student_steps)
        smallest = iteration + crossovers
        args.total_timesteps = int(smallest * g.uniform(1, 20))
        plan, steps = gpo_ppo.plan_rounds(args)
        assert steps == sum(plan) * iteration + len(plan) * crossovers
        assert 0 <= args.total_timesteps - steps < iteration
        assert min(plan) >= 1 and max(plan) - min(plan) <= 1 and plan == sorted(plan, reverse=True)
        assert len(plan) == min(args.rounds, args.total_timesteps // smallest)


def test_the_default_budget_is_twelve_rounds_of_eight_million_steps(make_args):
    plan, steps = gpo_ppo.plan_rounds(make_args())
    assert len(plan) == 12 and 8_000_000 - 8 * 2048 < steps <= 8_000_000


def test_randomness_depends_on_seed_purpose_and_indices_only():
    def draw(*key):
        return tuple(gpo_ppo.rng(*key).integers(2**62, size=2))

    keys = [(seed, purpose, *indices) for seed in (0, 1) for purpose in ("a", "b") for indices in ((0, 0), (0, 1), (1, 0))]
    first = [draw(*key) for key in keys]
    torch.manual_seed(5)
    np.random.seed(5)
    assert [draw(*key) for key in keys] == first and len(set(first)) == len(first)


def test_normal_noise_is_each_members_own():
    together = gpo_ppo.normal_noise(generators(3), 5, 2, 4)
    assert together.shape == (5, 3, 2, 4)
    np.testing.assert_array_equal(gpo_ppo.normal_noise(generators(3)[1:2], 5, 2, 4)[:, 0], together[:, 1])
