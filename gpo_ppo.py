# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "torch==2.13.0",
#     "numpy==2.4.6",
#     "gymnasium[mujoco]==1.4.0",
#     "mujoco==4.0.0",
#     "tyro==1.0.17",
#     "tensorboard==2.21.0",
#     "wandb==0.31.0",
#     "tqdm==4.70.1",
# ]
# ///
"""Genetic Policy Optimization with PPO mutation (Gangwani & Peng, ICLR 2018, https://arxiv.org/abs/1711.01012).

A population of Gaussian MLP policies repeats three operators (Algorithm 1): mutate improves every policy with PPO and lets
similar policies share their batches; select picks the fittest couples; crossover distils each couple into a child.
Example: python gpo_ppo.py --env-id HalfCheetah-v4 --population 8
"""

import contextlib
import ctypes
import fcntl
import io
import json
import math
import os
import signal
import sys
import time
import warnings
import zlib
from collections import deque
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # nets this small lose with threads; workers are the parallelism
import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import tyro
from gymnasium.vector import AutoresetMode

try:
    import gpo_envs  # registers rllab's tasks and batched stepping
except ModuleNotFoundError as missing:
    if missing.name != "gpo_envs":
        raise
    gpo_envs = None

# ---------------------------------------------------------------- flags; an annotation is the bound that `parse_args` checks

SCRIPT = {}  # what tells this script from its siblings; filled next to the functions that it names, used by `main`


@dataclass
class Experiment:
    exp_name: str | None = None
    """the name of this experiment, part of the run's name; default: the script's"""
    seed: Annotated[int, ">= 0"] = 1
    """the seed from which every random number of the run follows"""
    workers: Annotated[int | None, "> 0"] = None
    """processes that share the work; default: one per core this process may use, at most one per member"""
    max_restarts: Annotated[int, ">= 0"] = 3
    """how often a crashed group of workers starts again from the last checkpoint (with more than one worker)"""
    cuda: bool = False
    """whether to compute updates on the accelerator (a machine's worker r uses its device r modulo their number)"""
    run_dir: str = "runs"
    """the folder that holds the folders of all runs"""
    run_name: str | None = None
    """the name of this run's folder; default: {env_id}__{exp_name}__{seed}__{unix time}, under torchrun its --rdzv-id"""
    resume: str | None = None
    """the folder of a run that stopped: go on from its last checkpoint, with its flags"""
    track: bool = False
    """whether to send everything that is logged to Weights & Biases, too"""
    wandb_project_name: str = "gpo"
    """the project of Weights & Biases"""
    wandb_entity: str | None = None
    """the entity (team) of the Weights & Biases project"""


@dataclass
class Environment:
    env_id: str = "HalfCheetah-v4"
    """the id of any Gymnasium environment with Box observations and Box actions"""
    env_kwargs: str = "{}"
    """keyword arguments of the environment, as a JSON object"""
    max_episode_steps: Annotated[int | None, "> 0"] = None
    """the horizon, in steps; default: the smaller of 512 (the paper's) and the environment's own"""
    vectorization: Literal["auto", "sync"] = "auto"
    """auto: batched stepping where gpo_envs serves the id; sync: always Gymnasium's SyncVectorEnv"""
    num_envs: Annotated[int, "> 0"] = 4
    """the number of environments per member"""
    num_steps: Annotated[int, "> 0"] = 512
    """the number of steps in each environment per iteration; a member's batch is num_envs * num_steps"""


@dataclass
class Budget:
    total_timesteps: Annotated[int, "> 0"] = 8_000_000
    """environment steps of the whole run, all members and all phases of training together; never exceeded"""
    population: Annotated[int, "> 0"] = 8
    """the number of members, m in the paper"""


@dataclass
class Rounds:
    rounds: Annotated[int, "in [1, 100000]"] = 12
    """rounds of mutate, select and crossover; as many as fit into the budget"""


@dataclass
class PolicyGradient:
    learning_rate: Annotated[float, "> 0"] = 3e-3
    """Adam's learning rate of the policies"""
    critic_learning_rate: Annotated[float, "> 0"] = 1e-3
    """Adam's learning rate of the critics"""
    gamma: Annotated[float, "in [0, 1]"] = 0.99
    """the discount factor"""
    gae_lambda: Annotated[float, "in [0, 1]"] = 0.95
    """the lambda of generalized advantage estimation"""
    norm_adv: bool = True
    """whether advantages are normalized to mean 0 and deviation 1 over the batch of a gradient step"""
    norm_obs: bool = True
    """whether observations are normalized by running statistics, which are part of the policy"""
    norm_returns: bool = True
    """whether the critic's targets are divided by a slowly moving root mean square of the returns"""
    critic_epochs: Annotated[int, "> 0"] = 10
    """passes of the critic over each batch"""
    critic_minibatch_size: Annotated[int, "> 0"] = 256
    """samples per member and gradient step of the critic"""


@dataclass
class PPO:
    update_epochs: Annotated[int, "> 0"] = 10
    """full-batch gradient steps of the policy per iteration of PPO"""
    kl_coef: Annotated[float, "> 0"] = 1.0
    """the initial weight of PPO's KL penalty, beta in the paper; it adapts to kl_target"""
    kl_target: Annotated[float, "> 0"] = 0.01
    """the KL per iteration (nats) that beta aims at: doubled above 1.5 times, halved below 1/1.5 of it"""
    kl_hinge: Annotated[float, ">= 0"] = 100.0
    """the weight of the additional penalty max(0, KL - 2 kl_target)^2; 0 is the paper's loss"""


@dataclass
class Sharing:
    data_sharing: bool = True
    """whether similar policies share their batches (M in the paper's ablation)"""
    kl_sharing_threshold: Annotated[float, ">= 0"] = 0.5
    """policy i borrows from j if KL[i, j] was below this (nats) at the start of the round, epsilon in the paper"""
    importance_clip: Annotated[float, "> 0 or inf"] = 1.0
    """the cap of borrowed samples' importance ratios; inf is the paper's gradient"""


@dataclass
class Select:
    selection: Literal["fitness", "random"] = "fitness"
    """which couples breed: the fittest, or random ones (S in the paper's ablation)"""
    fitness: Literal["performance", "diversity", "mixture"] = "performance"
    """the fitness of a couple: sum of returns, symmetrized KL, or both as z-scores"""
    diversity_weight: Annotated[float, "in [0, 1]"] = 0.5
    """the weight of the KL in the mixture in round one; it falls linearly to 0 in the last round"""


@dataclass
class Crossover:
    crossover: Literal["state-space", "copy", "parameter"] = "state-space"
    """how a couple makes a child: distillation (C in the paper's ablation), copy of the stronger, random weights"""
    crossover_pool: Annotated[int, "> 0"] = 8192
    """the most recent transitions per parent from which pi_S is learned"""
    crossover_top: Annotated[float, "in [0, 1]"] = 0.6
    """the fraction of both parents' trajectories, best first, that pi_S learns from"""
    crossover_learning_rate: Annotated[float, "> 0"] = 5e-4
    """Adam's learning rate of pi_S and of the distillation"""
    crossover_minibatch_size: Annotated[int, "> 0"] = 64
    """samples per gradient step of pi_S and of the distillation"""
    pi_s_epochs: Annotated[int, "> 0"] = 100
    """passes of pi_S over its data"""
    expert_steps: Annotated[int, ">= 10"] = 5000
    """transitions of the two-headed expert pi_H per child, from ten environments"""
    student_steps: Annotated[int, "> 0"] = 500
    """transitions of the student per iteration of DAgger"""
    dagger_iterations: Annotated[int, ">= 0"] = 10
    """iterations of DAgger after the first fit to the expert's transitions"""
    dagger_epochs: Annotated[int, "> 0"] = 10
    """passes over the aggregated data per iteration of DAgger"""
    critic_warmup: Annotated[int, ">= 0"] = 2
    """iterations after a crossover that fit only the critic"""
    save_crossovers: bool = False
    """whether to keep parents and children of every round, not only of the first (crossover_001.pt)"""


@dataclass
class Comparison:
    comparison_episodes: Annotated[int, "> 0"] = 5
    """episodes by which children are compared with their parents after each crossover; outside the budget"""


@dataclass
class Evaluation:
    selection_episodes: Annotated[int, "> 0"] = 20
    """episodes per member at the end that choose the best member; outside the budget"""
    report_episodes: Annotated[int, "> 0"] = 100
    """episodes per member at the end, on other seeds, that are reported; outside the budget"""


@dataclass
class Args:
    experiment: Experiment = field(default_factory=Experiment)
    environment: Environment = field(default_factory=Environment)
    budget: Budget = field(default_factory=Budget)
    rounds: Rounds = field(default_factory=Rounds)
    policy_gradient: PolicyGradient = field(default_factory=PolicyGradient)
    ppo: PPO = field(default_factory=PPO)
    sharing: Sharing = field(default_factory=Sharing)
    select: Select = field(default_factory=Select)
    crossover: Crossover = field(default_factory=Crossover)
    comparison: Comparison = field(default_factory=Comparison)
    evaluation: Evaluation = field(default_factory=Evaluation)


BOUNDS = {
    "> 0": lambda x: 0 < x < math.inf,
    ">= 0": lambda x: 0 <= x < math.inf,
    ">= 10": lambda x: x >= 10,
    "> 0 or inf": lambda x: x > 0,
    "in [0, 1]": lambda x: 0 <= x <= 1,
    "in [1, 100000]": lambda x: 1 <= x <= 100_000,
}
MAY_CHANGE_ON_RESUME = "workers max_restarts cuda run_dir run_name resume track wandb_project_name wandb_entity".split()


def refuse(message):
    """Ends the program for bad input: one line on stderr, exit code 2."""
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        time.sleep(10)  # one line a machine: its first worker says it, and its end ends the others, unless only they refuse
    print(f"{Path(sys.argv[0]).name}: error: {' '.join(message.split())[:1000]}", file=sys.stderr, flush=True)
    raise SystemExit(2)


def parse_args(argv):
    """All flags in one namespace (args.seed, not args.experiment.seed), checked; a resumed run's come from its checkpoint.

    Adds what follows from them: flags (the plain values), obs_dim, act_dim, the horizon, workers, the run's name, plan.
    """

    def parse(default=None):
        try:
            with contextlib.redirect_stderr(io.StringIO()) as box:
                groups = tyro.cli(Args, args=argv, default=default, description=__doc__, config=(tyro.conf.OmitArgPrefixes,))
        except SystemExit as stop:
            if stop.code:
                refuse(" ".join(word for word in box.getvalue().split() if word.strip("╭╮╰╯│─+-|")))
            raise
        return SimpleNamespace(**{name: x for group in vars(groups).values() for name, x in vars(group).items()})

    args = parse()
    ranks = int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else None
    if ranks:  # started by torchrun, or by `launch`: all workers, and their restarts, must agree on the folder
        if args.workers not in (None, ranks):
            refuse(f"--workers {args.workers}: torchrun starts {ranks}; leave the flag out")
        args.run_name = args.run_name or os.environ["TORCHELASTIC_RUN_ID"]
        if args.run_name == "none" and not args.resume:
            refuse("torchrun needs --rdzv-id NAME, or the script --run-name NAME: the name of the run's folder")
        folder = Path(args.run_dir) / args.run_name
        if (folder / "checkpoint.pt").exists():
            args.resume = args.resume or str(folder)
    if args.resume:
        resume, stored = args.resume, load_checkpoint(args.resume)["flags"]
        args = parse(Args(**{f.name: f.type(**{g.name: stored[g.name] for g in fields(f.type)}) for f in fields(Args)}))
        for name, value in vars(args).items():
            if name not in MAY_CHANGE_ON_RESUME and value != stored[name]:
                refuse(f"--{name.replace('_', '-')} {value}: the run was started with {stored[name]}, which cannot change")
        args.resume, folder = resume, Path(resume).absolute()
        args.run_dir, args.run_name = str(folder.parent), folder.name
    args.flags = dict(vars(args), resume=None)

    for group in fields(Args):
        for flag in fields(group.type):
            value, bounds = getattr(args, flag.name), getattr(flag.type, "__metadata__", ())
            if value is not None and not all(BOUNDS[bound](value) for bound in bounds):
                refuse(f"--{flag.name.replace('_', '-')} {value}: must be {bounds[0]}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    args.workers = ranks or args.workers or min(cores, args.population)
    if args.workers > args.population:
        refuse(f"--workers {args.workers}: more than --population {args.population}; a worker needs at least one member")
    if args.cuda and not torch.cuda.is_available():
        refuse("--cuda: PyTorch sees no CUDA device here; leave the flag out to run on the CPU")
    check_environment(args)
    args.plan, args.budget_steps = SCRIPT["plan"](args)
    if not args.exp_name:
        args.exp_name = Path(__file__).stem.removesuffix("_baseline") + (f"_{args.algo}" if hasattr(args, "algo") else "")
    if not args.run_name:
        args.run_name = f"{args.env_id.replace('/', '-')}__{args.exp_name}__{args.seed}__{int(time.time())}"
    if not ranks or os.environ["RANK"] == "0":
        try:
            (Path(args.run_dir) / args.run_name).mkdir(parents=True, exist_ok=True)
            with open(Path(args.run_dir) / args.run_name / ".lock", "a"):
                pass
        except OSError as error:
            refuse(f"--run-dir {args.run_dir}: {error.strerror} ({error.filename})")
    return args


# ---------------------------------------------------------------- randomness


def rng(seed, purpose, *indices):
    """A generator of its own for each use, e.g. rng(1, "noise", segment, iteration, member).

    No stream is shared, so results depend neither on the number of workers nor on what ran before a checkpoint.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), *indices])


def env_seeds(num_envs, seed, purpose, *indices):
    """One seed per environment, as a list for `envs.reset`."""
    return rng(seed, purpose, *indices).integers(2**31, size=num_envs).tolist()


def normal_noise(generators, num_steps, num_envs, act_dim):
    """Standard normal numbers [steps, members, envs, act_dim], each member's from its own generator."""
    return np.stack([g.standard_normal((num_steps, num_envs, act_dim), np.float32) for g in generators], axis=1)


def shuffles(generators, samples, epochs, device):
    """Indices [members, epochs * samples]: a new order of a member's samples for each epoch."""
    orders = [np.concatenate([g.permutation(samples) for _ in range(epochs)]) for g in generators]
    return torch.from_numpy(np.stack(orders)).to(device)


# ---------------------------------------------------------------- environments


def check_environment(args):
    """Makes the environment once: refuses what a Gaussian policy cannot play, and sets obs_dim, act_dim, the horizon."""
    try:
        kwargs = json.loads(args.env_kwargs)
    except (ValueError, RecursionError):
        kwargs = None
    if not isinstance(kwargs, dict):
        refuse(f"--env-kwargs {args.env_kwargs!r}: must be a JSON object, such as '{{\"difficulty\": 0.5}}'")
    try:
        own_limit = gym.spec(args.env_id).max_episode_steps
        args.max_episode_steps = args.max_episode_steps or min(512, own_limit or 512)
        envs = make_envs(args, 1)
    except Exception as error:  # whatever is raised here is about the id or its keywords
        refuse(f"--env-id {args.env_id} --env-kwargs '{args.env_kwargs}': {error}")
    for name, space in (("action", envs.single_action_space), ("observation", envs.single_observation_space)):
        if not isinstance(space, gym.spaces.Box):
            refuse(f"--env-id {args.env_id}: its {name} space is {space}; only Box is supported")
    args.obs_dim = math.prod(envs.single_observation_space.shape)
    args.act_dim = math.prod(envs.single_action_space.shape)
    envs.close()


def make_envs(args, num_envs):
    """`num_envs` environments with SAME_STEP autoreset: batched where gpo_envs serves the id, else SyncVectorEnv.

    `--vectorization sync` always takes the latter, which is the place for wrappers of your own.
    """
    kwargs = {"max_episode_steps": args.max_episode_steps, **json.loads(args.env_kwargs)}
    served = str(gym.spec(args.env_id).vector_entry_point).startswith("gpo_envs")
    if not (served and args.vectorization == "auto"):
        kwargs |= {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": AutoresetMode.SAME_STEP}}
    with warnings.catch_warnings():
        # Gymnasium calls v4 tasks out of date and MuJoCo warns of settotalmass in its XML, once per environment.
        warnings.filterwarnings("ignore", message=".*out of date.*")
        warnings.filterwarnings("ignore", message=".*settotalmass.*")
        envs = gym.make_vec(args.env_id, num_envs, **kwargs)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    return envs


def rollout(envs, obs, act, num_steps):
    """Steps all environments `num_steps` times with SAME_STEP autoreset.

    act(obs [envs, obs_dim], t) returns actions [envs, act_dim]; they are clipped to the Box for the environment only.
    Returns time-major arrays: obs, next_obs (the true successor, final_obs at an end), actions, rewards, terminations,
    truncations, dones; last_obs, with which to go on; diverged [envs], simulations that blew up.
    """
    num_envs, obs_dim = obs.shape
    space = envs.single_action_space
    low, high = space.low.reshape(-1), space.high.reshape(-1)
    data = SimpleNamespace(
        obs=np.empty((num_steps, num_envs, obs_dim), np.float32),
        next_obs=np.empty((num_steps, num_envs, obs_dim), np.float32),
        actions=np.empty((num_steps, num_envs, low.size), np.float32),
        rewards=np.empty((num_steps, num_envs)),
        terminations=np.empty((num_steps, num_envs), bool),
        truncations=np.empty((num_steps, num_envs), bool),
        diverged=np.zeros(num_envs, bool),
    )
    for t in range(num_steps):
        data.obs[t] = obs
        data.actions[t] = actions = act(data.obs[t], t)
        actions = np.clip(actions, low, high).reshape(num_envs, *space.shape)
        obs, data.rewards[t], data.terminations[t], data.truncations[t], infos = envs.step(actions)
        obs = obs.reshape(num_envs, -1)
        data.next_obs[t] = obs
        if "final_obs" in infos:
            for e in np.flatnonzero(data.terminations[t] | data.truncations[t]):
                data.next_obs[t, e] = infos["final_obs"][e].reshape(-1)
        if "diverged" in infos:
            data.diverged |= infos["diverged"]
    data.dones = data.terminations | data.truncations
    data.last_obs = obs
    return data


def finished_episodes(open_episodes, data):
    """Cuts a roll-out at the ends of episodes; returns per environment those that ended, as (obs [L, obs_dim], return).

    open_episodes: per environment a list of (obs, return) pieces that earlier roll-outs left open; updated in place.
    """
    finished = []
    for e, pieces in enumerate(open_episodes):
        episodes, start = [], 0
        for end in np.flatnonzero(data.dones[:, e]) + 1:
            pieces.append((data.obs[start:end, e], data.rewards[start:end, e].sum()))
            episodes.append(join_pieces(pieces))
            pieces.clear()
            start = end
        if start < len(data.obs):
            pieces.append((data.obs[start:, e], data.rewards[start:, e].sum()))
        finished.append(episodes)
    return finished


def join_pieces(pieces):
    """One episode (obs [L, obs_dim], return) from its pieces."""
    return np.concatenate([obs for obs, _ in pieces]), float(sum(ret for _, ret in pieces))


# ---------------------------------------------------------------- networks: stacks of MLPs, one row of a flat buffer each


def policy_sizes(args):
    return (args.obs_dim, 64, 64, args.act_dim)


def critic_sizes(args):
    return (args.obs_dim, 32, 32, 1)


def make_net(flat, sizes, log_std=False, grad=None):
    """Views into a stack of MLPs, flat [members, P], and its gradient.

    Per layer (W [members, out, in], b [members, out, 1]) and the same of the gradient; log_std [members, act_dim, 1];
    rows: each member as a stack of one in the same memory.
    """
    net = SimpleNamespace(flat=flat, grad=torch.zeros_like(flat) if grad is None else grad, layers=[], sizes=sizes)
    at = 0
    for n_in, n_out in zip(sizes, sizes[1:]):
        W, W_grad = (x[:, at : at + n_out * n_in].view(-1, n_out, n_in) for x in (net.flat, net.grad))
        at += n_out * n_in
        b, b_grad = (x[:, at : at + n_out, None] for x in (net.flat, net.grad))
        at += n_out
        net.layers.append((W, b, W_grad, b_grad))
    if log_std:
        net.log_std, net.log_std_grad = (x[:, at : at + sizes[-1], None] for x in (net.flat, net.grad))
    members = range(len(flat)) if len(flat) > 1 else ()
    net.rows = [make_net(flat[i : i + 1], sizes, log_std, net.grad[i : i + 1]) for i in members] or [net]
    return net


def make_policy(flat, args):
    return make_net(flat, policy_sizes(args), log_std=True)


def init_rows(generators, sizes, output_std, log_std=False):
    """Orthogonally initialized MLPs [members, P], one per generator; biases and log-std 0.

    P is padded to a multiple of 16, so that vectorized kernels treat a member alike wherever its row stands.
    """
    count = sum(n_out * n_in + n_out for n_in, n_out in zip(sizes, sizes[1:])) + log_std * sizes[-1]
    flat = torch.zeros(len(generators), math.ceil(count / 16) * 16)
    net = make_net(flat, sizes)
    for i, generator in enumerate(generators):
        torch_generator = torch.Generator().manual_seed(int(generator.integers(2**62)))
        for W, *_ in net.layers:
            std = output_std if W is net.layers[-1][0] else math.sqrt(2)
            torch.nn.init.orthogonal_(W[i], std, generator=torch_generator)
    return flat


COLUMNS = 4  # kernels round by where a row starts in memory; so many float32 columns make 16 bytes, alike in any stack


def tanh_(x):
    """tanh in place; on the CPU NumPy's is several times faster than torch's."""
    return x.tanh_() if x.is_cuda else torch.from_numpy(np.tanh(x.numpy(), out=x.numpy()))


def forward(net, x):
    """Activations [x, h1, h2, output] of a stack; x is [members, in, samples]: columns are samples, as in Wx + b."""
    activations = [x]
    for W, b, *_ in net.layers[:-1]:
        activations.append(tanh_(torch.baddbmm(b, W, activations[-1])))
    W, b, *_ = net.layers[-1]
    return [*activations, torch.baddbmm(b, W, activations[-1])]


def backward(net, activations, grad):
    """Adds to net.grad the gradient of a loss whose derivative with respect to the output is grad [members, out, samples].

    Written out, since autograd's bookkeeping costs more than these small products: with h the input of a layer,
    dW = grad h^T, db = sum of grad; and below, through W and tanh, grad <- (W^T grad) (1 - h^2).
    """
    for (W, _, W_grad, b_grad), h in zip(reversed(net.layers), reversed(activations[:-1])):
        W_grad.add_(torch.bmm(grad, h.mT))
        b_grad.add_(grad.sum(-1, keepdim=True))
        if h is not activations[0]:
            grad = torch.bmm(W.mT, grad)
            grad.addcmul_(grad * h, h, value=-1)


def adam(net):
    """Gives a stack fresh moments for `adam_step`."""
    net.moments = torch.zeros_like(net.flat), torch.zeros_like(net.flat), torch.zeros(())


def adam_step(net, learning_rate):
    """One step of Adam (https://arxiv.org/abs/1412.6980) by net.grad; element by element, so members do not mix.

    This is the kernel of torch.optim.Adam(fused=True); the class around it costs several times the kernel here.
    """
    mean, square, step = net.moments
    torch._fused_adam_(
        *([net.flat], [net.grad], [mean], [square], [], [step.add_(1)]),
        **dict(lr=learning_rate, beta1=0.9, beta2=0.999, eps=1e-5, weight_decay=0.0, amsgrad=False, maximize=False),
    )


def fit(net, rows, output_gradient, indices, minibatch_size, step):
    """Minibatch gradient descent of a stack; step() uses net.grad.

    rows [members, samples, in + targets]; indices [members, steps * minibatch_size] of samples, in their order of use;
    output_gradient(output [members, out, minibatch], targets [members, targets, minibatch]) is the loss's derivative.
    """
    members, samples, width = rows.shape
    flat_rows, n_in = rows.reshape(members * samples, width), net.sizes[0]
    indices = indices + samples * torch.arange(members, device=rows.device)[:, None]
    for chunk in indices.split(minibatch_size, dim=1):
        size, more = chunk.shape[1], -chunk.shape[1] % COLUMNS  # more: columns without a gradient
        if more:
            chunk = torch.cat([chunk, chunk[:, :1].expand(-1, more)], dim=1)
        batch = flat_rows.index_select(0, chunk.reshape(-1)).view(members, -1, width).mT
        activations = forward(net, batch[:, :n_in])
        net.grad.zero_()  # before output_gradient, which may add the gradient of a log-std
        grad = output_gradient(activations[-1][..., :size], batch[:, n_in:, :size])
        backward(net, activations, torch.nn.functional.pad(grad, (0, more)) if more else grad)
        step()


# ---------------------------------------------------------------- Gaussian policies


def gaussian_log_prob(actions, mean, log_std):
    """log pi(a|s) [members, samples] of actions and mean [members, act_dim, samples]."""
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * z.square().sum(1) - log_std.sum(1) - 0.5 * mean.shape[1] * math.log(2 * math.pi)


def gaussian_kl(mean_p, log_std_p, mean_q, log_std_q):
    """KL[p || q] of diagonal Gaussians, [members, samples]."""
    var_ratio = torch.exp(2 * (log_std_p - log_std_q))
    squares = ((mean_p - mean_q) * torch.exp(-log_std_q)).square()
    return (0.5 * (var_ratio + squares - 1) + log_std_q - log_std_p).sum(1)


def policy_kl(policy, batch):
    """Mean KL[old, new] of one member over the states of its batch."""
    return gaussian_kl(batch.mean, batch.log_std, forward(policy, batch.obs)[-1], policy.log_std).mean().item()


def normalize(obs, stats):
    """Observations as networks see them; obs [..., members, samples, obs_dim] with statistics [members, obs_dim]."""
    return np.clip((obs - stats.mean[:, None]) * stats.inv_std[:, None], -10, 10)


def net_output(net, obs):
    """A stack's outputs [members, samples, out], for NumPy observations [members, samples, obs_dim], normalized."""
    samples = obs.shape[1]
    if samples % COLUMNS:
        obs = np.pad(obs, ((0, 0), (0, -samples % COLUMNS), (0, 0)), mode="edge")
    x = torch.from_numpy(obs).to(net.flat.device).mT
    return forward(net, x)[-1].mT.cpu().numpy()[:, :samples]


def sample_actions(policy, stats, noise):
    """act(obs, t) for `rollout`: Gaussian actions of a stack whose members own equally many environments in a row.

    noise: [steps, members, envs per member, act_dim], standard normal; None for the mean action.
    """
    members, std = len(policy.flat), policy.log_std.exp().mT.cpu().numpy()

    def act(obs, t):
        mean = net_output(policy, normalize(obs.reshape(members, -1, obs.shape[-1]), stats))
        return (mean if noise is None else mean + std * noise[t]).reshape(len(obs), -1)

    return act


# ---------------------------------------------------------------- mutate (Section 3.2.2)


def generalized_advantages(rewards, values, next_values, terminations, dones, gamma, gae_lambda):
    """GAE (https://arxiv.org/abs/1506.02438) over time-major arrays [steps, envs].

    A termination ends the value at 0, a truncation bootstraps from next_values, the value of the final observation;
    either cuts the sum of lambda-weighted errors.
    """
    advantages, lastgaelam = np.empty_like(values), np.zeros_like(values[0])
    deltas = rewards + gamma * np.where(terminations, 0.0, next_values) - values
    for t in reversed(range(len(rewards))):
        advantages[t] = lastgaelam = deltas[t] + gamma * gae_lambda * ~dones[t] * lastgaelam
    return advantages


def by_member(x, members):
    """Time-major [steps, members * envs, ...] to [members, steps * envs, ...]."""
    x = x.reshape(len(x), members, -1, *x.shape[2:]).swapaxes(0, 1)
    return np.ascontiguousarray(x).reshape(members, -1, *x.shape[3:])


def make_batches(args, data, policy, critic, stats):
    """A roll-out as one batch per member, with the critic's samples.

    A batch: obs [1, obs_dim, N], actions [1, act_dim, N], mean and log_std of the policy that acted, log_probs [1, N].
    The critic's: obs [members, N, obs_dim], values, returns and advantages [members, N], raw.
    """
    members, device = len(policy.flat), policy.flat.device
    obs, next_obs = (normalize(by_member(x, members), stats) for x in (data.obs, data.next_obs))
    obs, next_obs, actions = (torch.from_numpy(x).to(device) for x in (obs, next_obs, by_member(data.actions, members)))
    columns = obs.mT.contiguous()

    def values_of(x):
        values = np.concatenate([forward(row, x[i : i + 1])[-1][0].cpu().numpy() for i, row in enumerate(critic.rows)])
        values = values * stats.return_rms[:, None]
        return values.reshape(members, args.num_steps, -1).swapaxes(0, 1).reshape(data.rewards.shape)

    values, next_values = values_of(columns), values_of(next_obs.mT)
    advantages = generalized_advantages(
        data.rewards, values, next_values, data.terminations, data.dones, args.gamma, args.gae_lambda
    )
    batches = []
    for i, row in enumerate(policy.rows):
        batch = SimpleNamespace(obs=columns[i : i + 1], actions=actions[i : i + 1].mT.contiguous())
        batch.mean, batch.log_std = forward(row, batch.obs)[-1], row.log_std.clone()
        batch.log_probs = gaussian_log_prob(batch.actions, batch.mean, batch.log_std)
        batches.append(batch)
    return batches, (obs, *(by_member(x, members) for x in (values, values + advantages, advantages)))


def set_advantages(args, batches, advantages, pool):
    """Gives each batch its advantages [1, N], rows of [members, N]; --norm-adv by the rows of pool that they belong to."""
    for batch, own, normalizer in zip(batches, advantages, pool):
        if args.norm_adv:
            own = (own - normalizer.mean()) / (normalizer.std() + 1e-8)
        batch.advantages = torch.from_numpy(own.astype(np.float32)[None]).to(batch.obs.device)


def policy_gradient_terms(policy, batch, clip):
    """One batch's part of the surrogate's gradient, for A2C and PPO: mean of ratio * advantage, ratio = pi_i / pi_acting.

    A ratio above clip counts as the clip, detached (as in V-trace, https://arxiv.org/abs/1802.01561). With e = a - mean and
    v = exp(2 log_std): d log pi / d mean = e / v, d log pi / d log_std = e^2 / v - 1. Adds the latter's part to policy.grad;
    returns activations, the loss's derivative with respect to the mean [1, act_dim, N], 1 / v, and the loss.
    """
    activations = forward(policy, batch.obs)
    error, inv_var = batch.actions - activations[-1], torch.exp(-2 * policy.log_std)
    ratio = torch.exp(gaussian_log_prob(batch.actions, activations[-1], policy.log_std) - batch.log_probs).clamp_(max=clip)
    weight = (ratio * batch.advantages / ratio.shape[1])[:, None]
    scaled = error * inv_var
    policy.log_std_grad.sub_((weight * (scaled * error - 1)).sum(-1, keepdim=True))
    return activations, -weight * scaled, inv_var, -weight.sum().item()


def ppo_gradient(policy, batches, kl_coef, importance_clip=math.inf):
    """Adds to policy.grad the gradient of one member's -L^PPO (Section 3.2.2); returns its loss.

    batches: the member's own, then any of other policies. Their surrogates are summed; on the own, kl_coef * KL[old, new]
    is subtracted, and ratios are not clipped. With v = exp(2 log_std): d KL / d mean = (mean - old) / v and
    d KL / d log_std = 1 - (v_old + (mean - old)^2) / v.
    """
    loss = 0.0
    for k, batch in enumerate(batches):
        clip = importance_clip if k > 0 else math.inf
        activations, grad, inv_var, batch_loss = policy_gradient_terms(policy, batch, clip)
        if k == 0:
            drift, old_var = activations[-1] - batch.mean, torch.exp(2 * batch.log_std)
            grad.add_(drift * inv_var, alpha=kl_coef / drift.shape[2])
            kl_grad = 1 - ((old_var + drift.square()) * inv_var).mean(-1, keepdim=True)
            policy.log_std_grad.add_(kl_grad, alpha=kl_coef)
        backward(policy, activations, grad)
        loss += batch_loss
    return loss


def ppo_penalty(args, kl_coef, kl):
    """The weight of KL's gradient where the KL is kl: beta, and the slope of kl_hinge * max(0, KL - 2 kl_target)^2."""
    return kl_coef + 2 * args.kl_hinge * max(0.0, kl - 2 * args.kl_target)


def adapt_kl_coef(args, kl_coef, kl):
    """Beta for the next iteration, adapted to the KL of this one (https://arxiv.org/abs/1707.06347, Section 4)."""
    if kl > 1.5 * args.kl_target:
        return min(kl_coef * 2, 1e4)
    return max(kl_coef / 2, 1e-4) if kl < args.kl_target / 1.5 else kl_coef


def ppo_update(args, policy, batches, borrowed, kl_coefs):
    """PPO's full-batch steps for a stack; adapts kl_coefs in place. Returns losses and KLs, one per member.

    batches: each member's own; borrowed: per member a list of others' batches, perhaps empty.
    """
    losses, kls = [0.0] * len(batches), [0.0] * len(batches)
    for _ in range(args.update_epochs):
        policy.grad.zero_()
        for i, (row, own) in enumerate(zip(policy.rows, batches)):
            penalty = ppo_penalty(args, kl_coefs[i].item(), kls[i])
            losses[i] = ppo_gradient(row, [own, *borrowed[i]], penalty, getattr(args, "importance_clip", math.inf))
        adam_step(policy, args.learning_rate)
        kls = [policy_kl(row, own) for row, own in zip(policy.rows, batches)]
    for i, kl in enumerate(kls):
        kl_coefs[i] = adapt_kl_coef(args, kl_coefs[i].item(), kl)
    return losses, kls


def update_critics(args, critic, obs, targets, generators):
    """Fits a stack of critics to targets [members, N] by the mean squared error."""
    rows = torch.cat([obs, torch.from_numpy(targets.astype(np.float32)).to(obs.device)[..., None]], dim=2)
    indices = shuffles(generators, obs.shape[1], args.critic_epochs, obs.device)

    def squared_error_gradient(values, targets):
        return (values - targets) / values.shape[2]

    def step():
        adam_step(critic, args.critic_learning_rate)

    fit(critic, rows, squared_error_gradient, indices, args.critic_minibatch_size, step)


def batch_moments(obs, returns):
    """Of one member's batch: count, mean and sum of squared deviations of raw obs [N, obs_dim]; mean square of returns."""
    obs = obs.astype(np.float64)
    mean = obs.mean(0)
    return len(obs), mean, np.square(obs - mean).sum(0), np.square(returns).mean()


def update_statistics(args, population, i, moments):
    """Adds batches, as moments in the given order, to local member i's statistics (Chan et al. 1979 for observations)."""
    moments = [batch for batch in moments if all(np.isfinite(x).all() for x in batch)]  # a broken member spoils no other
    for count, mean, m2, _ in moments if args.norm_obs else ():
        old = population.obs_count[i].item()
        delta = torch.from_numpy(mean) - population.obs_mean[i]
        population.obs_m2[i] += torch.from_numpy(m2) + delta**2 * (old * count / (old + count))
        population.obs_mean[i] += delta * (count / (old + count))
        population.obs_count[i] += count
    if args.norm_returns and moments:  # an average over about the last 20 iterations
        population.return_weight[i] = 0.95 * population.return_weight[i] + 1
        population.return_square[i] = 0.95 * population.return_square[i] + np.mean([m[3] for m in moments])


def statistics(population):
    """What networks use of running statistics: mean, inv_std [members, obs_dim], return_rms [members]; at first 0, 1, 1."""
    fresh = population.obs_count == 0
    var = population.obs_m2 / population.obs_count.clamp(min=1)[:, None]
    var[fresh] = 1
    square = population.return_square / population.return_weight.clamp(min=1)
    square[population.return_weight == 0] = 1
    return SimpleNamespace(
        mean=population.obs_mean.float().numpy(),
        inv_std=(1 / (var + 1e-8).sqrt()).float().numpy(),
        return_rms=(square + 1e-8).sqrt().numpy(),
    )


def row_of(stats, i):
    """Member i's statistics, as a stack of one."""
    return SimpleNamespace(**{name: x[i : i + 1] for name, x in vars(stats).items()})


def kl_row(own, obs, policies, args):
    """KL[pi_i, pi_j] of a member i (a stack of one) to each of policies [m, P], mean over i's observations; [m]."""
    mean, kls = forward(own, obs)[-1], []
    for j in range(len(policies)):
        other = make_policy(policies[j : j + 1], args)
        kls.append(gaussian_kl(mean, own.log_std, forward(other, obs)[-1], other.log_std).mean().item())
    return np.array(kls)


def share(batches):
    """All members' batches, as far as a borrower needs them."""
    names = ("obs", "actions", "advantages", "log_probs")
    shared = gather([{name: getattr(batch, name).cpu().numpy() for name in names} for batch in batches])
    device = batches[0].obs.device
    return [SimpleNamespace(**{name: torch.from_numpy(x).to(device) for name, x in batch.items()}) for batch in shared]


# ---------------------------------------------------------------- select (Section 3.2.3)


def select(args, generation, fitness, kl):
    """The m couples that breed, as index pairs x < y; ties are broken by index.

    fitness [m]: mean returns, NaN for a member that must not breed; kl [m, m]: KL[i, j]. Fewer couples than m are
    used again in turn; a single healthy member is paired with itself; none raises RuntimeError.
    """
    m = len(fitness)
    healthy = [i for i in range(m) if np.isfinite(fitness[i])]
    if not healthy:
        raise RuntimeError("no member of the population has a finite return")
    if len(healthy) == 1:
        return [(healthy[0], healthy[0])] * m
    couples = list(combinations(healthy, 2))
    if args.selection == "random":
        order = rng(args.seed, "select", generation).permutation(len(couples))
    else:
        order = np.argsort(-couple_fitness(args, generation, couples, fitness, kl), kind="stable")
    return [couples[order[k % len(couples)]] for k in range(m)]


def couple_fitness(args, generation, couples, fitness, kl):
    """Performance, diversity, or their mixture as z-scores over couples, the weight of diversity annealed over rounds."""
    performance = np.array([fitness[x] + fitness[y] for x, y in couples])
    diversity = np.array([kl[x, y] + kl[y, x] for x, y in couples])
    if args.fitness != "mixture":
        return performance if args.fitness == "performance" else diversity
    weight = args.diversity_weight * (1 - generation / max(len(args.plan) - 1, 1))
    z_performance, z_diversity = ((x - x.mean()) / (x.std() + 1e-8) for x in (performance, diversity))
    return (1 - weight) * z_performance + weight * z_diversity


# ---------------------------------------------------------------- crossover (Section 3.2.1)


def selector_data(args, pools, couple, stats):
    """pi_S's samples: rows [N, obs_dim + 2] of normalized observation, weight if from x, weight if from y.

    pools[i]: member i's recent trajectories as (obs [L, obs_dim], return). The best of both parents' together are kept.
    """
    trajectories = [(obs, ret, parent) for parent, i in enumerate(couple) for obs, ret in pools[i]]
    trajectories.sort(key=lambda trajectory: -trajectory[1])
    kept = trajectories[: max(1, int(args.crossover_top * len(trajectories)))]
    best, worst = kept[0][1], kept[-1][1]
    rows = []
    for obs, ret, parent in kept:
        row = np.zeros((len(obs), args.obs_dim + 2), np.float32)
        row[:, :-2] = normalize(obs[None], row_of(stats, 0))[0]
        row[:, -2 + parent] = 0.1 + (ret - worst) / (best - worst) if best > worst else 1.0
        rows.append(row)
    rows = np.concatenate(rows)
    rows[:, -2:] /= rows[:, -2:].sum() / len(rows)
    return rows


def train_selector(args, generation, slots, rows, steps, device):
    """pi_S of each couple by return-weighted maximum likelihood (Equation 1), all as one stack; outputs are logits.

    rows: each couple's samples. All take `steps` gradient steps; a data set that is through before starts again.
    """
    sizes = (args.obs_dim, 32, 32, 2)
    pi_s = make_net(init_rows([rng(args.seed, "pi_s", generation, slot) for slot in slots], sizes, 0.01).to(device), sizes)
    adam(pi_s)
    padded = torch.zeros(len(rows), max(map(len, rows)), args.obs_dim + 2, device=device)
    samples, indices = steps * args.crossover_minibatch_size, []
    for k, slot in enumerate(slots):
        padded[k, : len(rows[k])] = torch.from_numpy(rows[k])
        generator, epochs = rng(args.seed, "pi_s_shuffle", generation, slot), math.ceil(samples / len(rows[k]))
        indices.append(shuffles([generator], len(rows[k]), epochs, device)[:, :samples])

    def cross_entropy_gradient(logits, weights):
        return (torch.softmax(logits, 1) * weights.sum(1, keepdim=True) - weights) / logits.shape[2]

    def step():
        adam_step(pi_s, args.crossover_learning_rate)

    fit(pi_s, padded, cross_entropy_gradient, torch.cat(indices), args.crossover_minibatch_size, step)
    return pi_s


def expert_targets(pi_s, parents, obs, uniform):
    """pi_H's Gaussian per state, (mean, log_std) in one array: the parent is drawn once from pi_S, and kept.

    obs [children, samples, obs_dim] normalized; uniform [children, samples] in (0, 1); parents: the stacks of x and of y.
    """
    logits = net_output(pi_s, obs)
    choose_x = np.log(uniform / (1 - uniform)) < logits[..., 0] - logits[..., 1]  # uniform < pi_S(x|s)
    targets = []
    for parent in parents:
        mean = net_output(parent, obs)
        targets.append(np.concatenate([mean, np.broadcast_to(parent.log_std.mT.cpu().numpy(), mean.shape)], axis=2))
    return np.where(choose_x[..., None], *targets)


def dagger_rollout(args, generation, slots, iteration, num_envs, num_steps, pi_s, parents, student, stats):
    """Transitions labelled by pi_H: rows [children, N, obs_dim + 2 * act_dim]; pi_H acts, or the student if there is one."""
    n, generators = len(slots), [rng(args.seed, "dagger", generation, slot, iteration) for slot in slots]
    noise = normal_noise(generators, num_steps, num_envs, args.act_dim)
    uniform = np.stack([1 - g.uniform(size=(num_steps, num_envs)) * (1 - 1e-9) for g in generators], axis=1)
    labels = []

    def expert(obs, t):
        labels.append(expert_targets(pi_s, parents, normalize(obs.reshape(n, num_envs, -1), stats), uniform[t]))
        mean, log_std = np.split(labels[-1], 2, axis=2)
        return (mean + np.exp(log_std) * noise[t]).reshape(n * num_envs, -1)

    envs = make_envs(args, n * num_envs)
    seeds = [env_seeds(num_envs, args.seed, "dagger_envs", generation, slot, iteration) for slot in slots]
    obs, _ = envs.reset(seed=sum(seeds, []))
    act = sample_actions(student, stats, noise) if student else expert
    data = rollout(envs, obs.reshape(n * num_envs, -1), act, num_steps)
    envs.close()
    obs = normalize(by_member(data.obs, n), stats)
    if student:
        labels = expert_targets(pi_s, parents, obs, uniform.swapaxes(0, 1).reshape(n, -1))
    else:
        labels = by_member(np.stack(labels).reshape(num_steps, n * num_envs, -1), n)
    return torch.from_numpy(np.concatenate([obs, labels], axis=2).astype(np.float32)), by_member(data.rewards, n).mean(1)


def distill(args, generation, slots, child, pi_s, parents, stats):
    """DAgger (Appendix): fits a stack of children to pi_H by KL[pi_c, pi_H] (Equation 2). Returns facts per child."""
    adam(child)
    d, a, device = args.obs_dim, args.act_dim, child.flat.device

    def kl_gradient(mean, targets):
        inv_var = torch.exp(-2 * targets[:, a:])
        child.log_std_grad.add_((torch.exp(2 * child.log_std) * inv_var - 1).mean(-1, keepdim=True))
        return (mean - targets[:, :a]) * inv_var / mean.shape[2]

    def step():
        adam_step(child, args.crossover_learning_rate)

    def transitions(iteration, num_envs, num_steps, student):
        return dagger_rollout(args, generation, slots, iteration, num_envs, num_steps, pi_s, parents, student, stats)

    rows, expert_rewards = transitions(0, 10, args.expert_steps // 10, None)
    rows, student_rewards = rows.to(device), expert_rewards
    for iteration in range(args.dagger_iterations + 1):
        if iteration > 0:
            new, student_rewards = transitions(iteration, 1, args.student_steps, child)
            rows = torch.cat([rows, new.to(device)], dim=1)
        generators = [rng(args.seed, "dagger_shuffle", generation, slot, iteration) for slot in slots]
        indices = shuffles(generators, rows.shape[1], args.dagger_epochs, device)
        fit(child, rows, kl_gradient, indices, args.crossover_minibatch_size, step)

    obs, mean, log_std = rows[..., :d].mT, rows[..., d : d + a].mT, rows[..., d + a :].mT
    facts = []
    for k, row in enumerate(child.rows):
        here = slice(k, k + 1)
        targets = [(mean[here], log_std[here])] + [(forward(p.rows[k], obs[here])[-1], p.rows[k].log_std) for p in parents]
        own = forward(row, obs[here])[-1]
        kls = [gaussian_kl(own, row.log_std, *target).mean().item() for target in targets]
        rewards = {"expert_reward": float(expert_rewards[k]), "student_reward": float(student_rewards[k])}
        facts.append({"distillation_kl": kls[0], "kl_to_parents": kls[1:], **rewards})
    return facts


def crossover(args, generation, slots, couples, parents, pools, stats):
    """The children of couples[slot] for the local slots: policies [children, P], facts per child, pi_S [children, Q] or None.

    parents: policies [m, P] and fitness [m] of the whole population; a child starts as a copy of the stronger parent.
    """
    mine = [couples[slot] for slot in slots]
    children = parents.policies[[stronger(couple, parents.fitness) for couple in mine]].clone()
    facts = [{} for _ in slots]
    if args.crossover == "parameter":
        for k, (slot, (x, y)) in enumerate(zip(slots, mine)):
            from_x = torch.from_numpy(rng(args.seed, "parameter", generation, slot).random(children.shape[1]) < 0.5)
            children[k] = torch.where(from_x.to(children.device), parents.policies[x], parents.policies[y])
    if args.crossover != "state-space" or mine[0][0] == mine[0][1]:  # a lone healthy member is only copied
        return children, facts, None

    rows, clock = {couple: selector_data(args, pools, couple, stats) for couple in set(couples)}, [time.perf_counter()]
    steps = args.pi_s_epochs * math.ceil(max(map(len, rows.values())) / args.crossover_minibatch_size)
    pi_s = train_selector(args, generation, slots, [rows[couple] for couple in mine], steps, children.device)
    clock.append(time.perf_counter())
    stacks = [make_policy(parents.policies[[couple[side] for couple in mine]], args) for side in (0, 1)]
    facts = distill(args, generation, slots, make_policy(children, args), pi_s, stacks, stats)
    clock.append(time.perf_counter())
    for couple, net, fact in zip(mine, pi_s.rows, facts):
        row = torch.from_numpy(rows[couple]).to(children.device)
        says_y = forward(net, row[None, :, :-2].mT)[-1][0].argmax(0)
        fact["pi_s_accuracy"] = (says_y == row[:, -2:].argmax(1)).float().mean().item()
        fact["share_x"] = (row[:, -2] > 0).float().mean().item()
        fact["seconds"] = dict(zip(("pi_s", "dagger"), np.diff(clock).tolist()))
    return children, facts, pi_s.flat


def stronger(couple, fitness):
    """The parent with the higher fitness; the first if they are equal."""
    return max(couple, key=lambda i: fitness[i])


def crossover_steps(args):
    """Environment steps of one round's crossovers of the whole population."""
    if args.crossover != "state-space":
        return 0
    return args.population * (args.expert_steps // 10 * 10 + args.dagger_iterations * args.student_steps)


# ---------------------------------------------------------------- evaluation


def evaluate(args, policy, stats, purpose, episodes, mean_action=False):
    """Raw returns [members, episodes] of complete episodes; all members meet the same starts and the same noise."""
    members, width = len(policy.flat), min(episodes, 20)
    envs, returns = make_envs(args, members * width), []
    for chunk in range(math.ceil(episodes / width)):
        obs, _ = envs.reset(seed=env_seeds(width, args.seed, purpose, chunk) * members)
        noise = normal_noise([rng(args.seed, purpose, chunk, 1)], args.max_episode_steps, width, args.act_dim)
        act = sample_actions(policy, stats, None if mean_action else noise)
        data = rollout(envs, obs.reshape(members * width, -1), act, args.max_episode_steps)
        in_first_episode = np.cumsum(data.dones, axis=0) - data.dones == 0
        rewards = np.ascontiguousarray((data.rewards * in_first_episode).T)  # a row is added alike next to any others
        returns.append(rewards.sum(1).reshape(members, width))
    envs.close()
    return np.concatenate(returns, axis=1)[:, :episodes]


def evaluation_cost(args, episodes):
    """Environment steps of one `evaluate` call per member."""
    width = min(episodes, 20)
    return math.ceil(episodes / width) * width * args.max_episode_steps


def final_evaluation(args, policy, stats, ids):
    """Every member plays selection episodes, and report episodes on other seeds; the best is chosen on the first only,
    because the maximum that won a selection is biased upward. Returns the content of evaluation.json, less the steps.
    """
    members = []
    if ids:
        selection = evaluate(args, policy, stats, "selection", args.selection_episodes)
        report, mean_action = (evaluate(args, policy, stats, "report", args.report_episodes, x) for x in (False, True))
        for i, member in enumerate(ids):
            returns = {"selection": selection[i], "report": report[i], "mean_action": mean_action[i]}
            means = {f"{name}_return": float(x.mean()) for name, x in returns.items()}
            members.append({"id": member, **means, "report_std": float(report[i].std())})
    members = gather(members)
    best = max(members, key=lambda member: np.nan_to_num(member["selection_return"], nan=-math.inf))
    return {
        "best": best["report_return"],
        "best_std": best["report_std"],
        "best_mean_action": best["mean_action_return"],
        "best_id": best["id"],
        "best_slot": members.index(best),
        "mean": float(np.mean([member["report_return"] for member in members])),
        "selection_episodes": args.selection_episodes,
        "report_episodes": args.report_episodes,
        "members": members,
    }


# ---------------------------------------------------------------- workers


def world():
    """(rank, number of workers) of this process."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def local_slots(population):
    """The members that this worker owns; any split will do."""
    rank, workers = world()
    return np.array_split(np.arange(population), workers)[rank].tolist()


def gather(values):
    """Lists of one value per local member, joined over all workers in member order."""
    if world()[1] == 1:
        return values
    parts = [None] * world()[1]
    dist.all_gather_object(parts, values)
    return [value for part in parts for value in part]


def gather_rows(stack, sizes=None):
    """The rows of all workers' stacks, in member order, as one stack on the same device; sizes: rows per worker, if known."""
    if world()[1] == 1:
        return stack.clone()
    sizes = sizes or gather([len(stack)])
    padded = torch.zeros(max(sizes), *stack.shape[1:], dtype=stack.dtype)
    padded[: len(stack)] = stack
    parts = torch.empty(len(sizes) * max(sizes), *stack.shape[1:], dtype=stack.dtype)
    dist.all_gather_single(parts, padded)
    return torch.cat([part[:size] for part, size in zip(parts.split(max(sizes)), sizes)]).to(stack.device)


def launch(args, argv):
    """Runs this script once per worker through torch's elastic launcher, which restarts the group if a worker crashes."""
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=args.workers,
        run_id=args.run_name,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=args.max_restarts,
        monitor_interval=0.5,
    )
    folder = Path(args.run_dir) / args.run_name
    try:
        elastic_launch(config, sys.executable)(__file__, *argv, "--run-name", args.run_name)
    except SignalException as stop:
        print(f"stopped; go on with --resume {folder}", file=sys.stderr)
        raise SystemExit(128 + stop.sigval.value) from None
    except ChildFailedError as failure:
        code = next(iter(failure.failures.values())).exitcode
        print(f"a worker ended with exit code {code}; its error is above, its run in {folder}", file=sys.stderr)
        raise SystemExit(2 if code == 2 else 1) from None
    return json.loads((folder / "evaluation.json").read_text())


def start_worker(args):
    """Joins the group of all machines' workers, and makes sure that they belong together."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: die with the launcher, however it ends
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the launcher answers it
    dist.init_process_group("gloo")


def agree(args):
    """Refuses workers that were started with different flags, or whose machine does not see the folder of the run."""
    everyone = gather([{**args.flags, "run_dir": None, "resume": bool(args.resume)}])  # machines may mount it elsewhere
    for name, first in everyone[0].items():
        for rank, flags in enumerate(everyone):
            if flags[name] != first:
                flag = f"--{name.replace('_', '-')}"
                refuse(f"{flag}: {first} for worker 0, {flags[name]} for worker {rank}; give all machines the same flags")
    token = Path(args.run_dir) / args.run_name / gather([f".token_{os.urandom(8).hex()}"])[0]
    if world()[0] == 0:
        token.touch()
    dist.barrier()
    patience = time.monotonic() + 10  # network file systems may show a new file late
    while not token.exists() and time.monotonic() < patience:
        time.sleep(0.1)
    blind = [host for host in gather(["" if token.exists() else os.uname().nodename]) if host]
    if world()[0] == 0:
        token.unlink()
    if blind:
        refuse(f"--run-dir {args.run_dir}: not one folder for all machines ({blind[0]} misses a file that worker 0 wrote)")


# ---------------------------------------------------------------- a run's folder


def new_population(args, slots):
    """Random policies and critics for the local slots, and empty statistics; every field has one row per member."""
    n = len(slots)
    return SimpleNamespace(
        policies=init_rows([rng(args.seed, "policy", slot) for slot in slots], policy_sizes(args), 0.01, log_std=True),
        critics=init_rows([rng(args.seed, "critic", slot) for slot in slots], critic_sizes(args), 1.0),
        kl_coefs=torch.full((n,), getattr(args, "kl_coef", 0.0), dtype=torch.float64),
        obs_count=torch.zeros(n, dtype=torch.float64),
        obs_mean=torch.zeros(n, args.obs_dim, dtype=torch.float64),
        obs_m2=torch.zeros(n, args.obs_dim, dtype=torch.float64),
        return_square=torch.zeros(n, dtype=torch.float64),
        return_weight=torch.zeros(n, dtype=torch.float64),
        ids=torch.tensor(slots, dtype=torch.int64),
    )


def save_atomically(content, path):
    """Writes beside and renames, so that a reader finds the old file or the new one, never half of one."""
    beside = path.with_name(path.name + ".tmp")
    with open(beside, "wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


def save_checkpoint(args, run, population):
    """All that the rest of the run depends on, as tensors and plain values; every worker calls, the first one writes."""
    stacks = {name: gather_rows(stack).cpu() for name, stack in vars(population).items()}
    if world()[0] == 0:
        content = {"format": 1, "flags": args.flags, "population": stacks, "progress": run.progress}
        save_atomically(content, run.folder / "checkpoint.pt")


def load_checkpoint(folder):
    """The checkpoint in a run's folder; refuses what is not one."""
    path = Path(folder) / "checkpoint.pt"
    if not path.is_file():
        refuse(f"--resume {folder}: there is no {path.name} in this folder")
    try:
        checkpoint = torch.load(path, weights_only=True)
        expected = {f.name for group in fields(Args) for f in fields(group.type)}
        if checkpoint["format"] != 1 or set(checkpoint["flags"]) != expected:
            raise ValueError("another script's or another version's")
    except Exception as error:
        reason = " ".join(str(error).split())[:100]
        refuse(f"--resume {folder}: {path.name} is no checkpoint of this script ({type(error).__name__}: {reason})")
    return checkpoint


def save_policy(args, folder, result, policies, stats):
    """policy.pt: the best member with its normalizer, and what is needed to play it."""
    rows = gather(list(zip(policies.cpu(), stats.mean, stats.inv_std)))
    if world()[0] == 0:
        policy, mean, inv_std = rows[result["best_slot"]]
        content = {"format": 1, "flags": args.flags, "max_episode_steps": args.max_episode_steps, "policy": policy.clone()}
        content |= {"sizes": list(policy_sizes(args)), "mean": torch.from_numpy(mean), "inv_std": torch.from_numpy(inv_std)}
        save_atomically({**content, "id": result["best_id"], "report_return": result["best"]}, folder / "policy.pt")


def lock(folder):
    """Holds a run's folder for this process; refuses one that a live run holds."""
    handle = open(folder / ".lock", "a")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        refuse(f"{folder}: a live run holds this folder; wait for its end or stop it first")
    return handle


def open_run(args, population):
    """The run's folder, progress, log(scalars) and show(text), and its population: the given one, or the checkpoint's."""
    run = SimpleNamespace(folder=Path(args.run_dir) / args.run_name, log=lambda *_: None, show=lambda *_: None)
    run.progress = {"segment": 0, "global_step": 0, "evaluation_steps": 0, "seconds": 0.0}
    if world()[1] > 1:
        agree(args)
    if args.resume:
        checkpoint = load_checkpoint(args.resume)
        run.progress = checkpoint["progress"]
        for name, stack in checkpoint["population"].items():
            setattr(population, name, stack[local_slots(len(stack))])
    local_rank = int(os.environ.get("LOCAL_RANK", 0))
    device = torch.device("cuda", local_rank % torch.cuda.device_count()) if args.cuda else torch.device("cpu")
    population.policies, population.critics = population.policies.to(device), population.critics.to(device)
    run.start = time.perf_counter() - run.progress["seconds"]
    if world()[0] == 0:
        run.lock = lock(run.folder)
        names = ("torch", "gymnasium", "mujoco", "numpy", "tyro", "tensorboard", "wandb")
        versions = {"python": sys.version.split()[0], **{name: version(name) for name in names}}
        (run.folder / "args.json").write_text(json.dumps({**args.flags, "versions": versions}, indent=1) + "\n")
        run.log, run.show = make_log(args, run), make_show(args, run)
        if gpo_envs is None:
            print("gpo_envs is not here: environments are stepped by Gymnasium's SyncVectorEnv", flush=True)
        steps = args.budget_steps
        print(
            f"{run.folder}: population {args.population}, {world()[1]} worker(s), iterations {args.plan}, horizon"
            f" {args.max_episode_steps}; {steps} of {args.total_timesteps} steps, {steps // args.population} per member",
            flush=True,
        )
    if not args.resume:
        save_checkpoint(args, run, population)
    return run


def close_run(args, run, population):
    """Final evaluation, policy.pt and evaluation.json; returns the latter's content."""
    stats, ids = statistics(population), population.ids.tolist() if len(population.ids) else []
    result = final_evaluation(args, make_policy(population.policies, args), stats, ids)
    per_member = evaluation_cost(args, args.selection_episodes) + 2 * evaluation_cost(args, args.report_episodes)
    run.progress["evaluation_steps"] += len(result["members"]) * per_member
    result |= {name: run.progress[name] for name in ("global_step", "evaluation_steps")}
    save_policy(args, run.folder, result, population.policies, stats)
    if world()[0] == 0:
        (run.folder / "evaluation.json").write_text(json.dumps(result, indent=1) + "\n")
        run.log({"eval/episodic_return": result["best"], "eval/mean_return": result["mean"]})
        minutes = (time.perf_counter() - run.start) / 60
        run.show(
            f"best {result['best']:.1f} +- {result['best_std']:.1f} (member {result['best_id']}), mean of members"
            f" {result['mean']:.1f}, {args.report_episodes} episodes each; {minutes:.1f} min; everything is in {run.folder}",
            final=True,
        )
    return result


# ---------------------------------------------------------------- what one sees


def make_log(args, run):
    """log(scalars): to TensorBoard and, with --track, to W&B; both get one monotone step, the total of environment steps."""
    from torch.utils.tensorboard import SummaryWriter

    step = run.progress["global_step"]
    writer = SummaryWriter(run.folder, purge_step=step + 1 if step else None)
    writer.add_text("hyperparameters", "|param|value|\n|-|-|\n" + "\n".join(f"|{k}|{v}|" for k, v in args.flags.items()))
    if args.track:
        import wandb

        name = run.folder.name
        wandb.init(
            **dict(project=args.wandb_project_name, entity=args.wandb_entity, name=name, id=name, resume="allow"),
            **dict(config=args.flags, save_code=True, dir=run.folder),
        )

    def log(scalars):
        for name, value in scalars.items():
            writer.add_scalar(name, value, run.progress["global_step"])
        writer.flush()
        if args.track:
            wandb.log({**scalars, "global_step": run.progress["global_step"]}, step=run.progress["global_step"])

    return log


def make_show(args, run):
    """show(text): one bar on a terminal; elsewhere plain lines, at most one in ten seconds. final=True always shows."""
    from tqdm import tqdm

    terminal = sys.stderr.isatty()
    first, start, last = run.progress["global_step"], time.time(), [0.0]
    bar = tqdm(total=args.budget_steps, initial=first, unit="step", unit_scale=True, disable=not terminal)

    def show(text, final=False):
        step = run.progress["global_step"]
        if terminal:
            bar.update(step - bar.n)
            bar.set_postfix_str("" if final else text)
        if final:
            bar.close()
            print(text, flush=True)
        elif not terminal and time.time() - last[0] > 10:
            last[0] = time.time()
            left = (args.budget_steps - step) * (time.time() - start) / max(step - first, 1) / 60
            print(f"{step} steps, {text}, {left:.1f} min left", flush=True)

    return show


def member_facts(policy, episodes, values, returns):
    """What one member (a stack of one) contributes to an iteration's scalars; episodes: (obs, return), values, returns [N]."""
    variance = returns.var()
    return {
        "episodes": [(ret, len(obs)) for obs, ret in episodes],
        "losses/value_loss": 0.5 * float(np.square(values - returns).mean()),
        "losses/explained_variance": 1 - float((returns - values).var() / variance) if variance > 0 else math.nan,
        "losses/entropy": (policy.log_std + 0.5 * math.log(2 * math.pi * math.e)).sum().item(),
    }


def iteration_scalars(args, run, facts, seconds):
    """What is logged after an iteration; facts: `member_facts` of the whole population; seconds: by phase, of this worker."""
    progress = run.progress
    scalars = {name: float(np.mean([fact[name] for fact in facts])) for name in facts[0] if name != "episodes"}
    returns = {i: np.mean([ret for ret, _ in fact["episodes"]]) for i, fact in enumerate(facts) if fact["episodes"]}
    if returns:
        scalars["charts/episodic_return"] = float(np.mean([ret for fact in facts for ret, _ in fact["episodes"]]))
        scalars["charts/episodic_length"] = float(np.mean([length for fact in facts for _, length in fact["episodes"]]))
        for name, function in (("best", np.max), ("mean", np.mean), ("min", np.min), ("std", np.std)):
            scalars[f"population/{name}_return"] = float(function(list(returns.values())))
        scalars |= {f"population/return_{i}": float(ret) for i, ret in returns.items()}
    scalars["charts/learning_rate"] = args.learning_rate
    scalars["charts/SPS"] = progress["global_step"] / progress["seconds"]
    return {**scalars, **{f"time/{phase}": s for phase, s in seconds.items()}}


def show_iteration(args, run, scalars):
    best, mean = (scalars.get(f"population/{name}_return", math.nan) for name in ("best", "mean"))
    segment = f"{SCRIPT['segment']} {run.progress['segment'] + 1}/{len(args.plan)}"
    run.show(f"{segment}, best {best:.0f}, mean {mean:.0f}, {scalars['charts/SPS']:.0f} SPS")


def stopwatch():
    """lap(phase) adds the seconds since the last lap to a dict, which it returns."""
    seconds, last = {}, [time.perf_counter()]

    def lap(phase):
        now = time.perf_counter()
        seconds[phase] = seconds.get(phase, 0.0) + now - last[0]
        last[0] = now
        return seconds

    return lap


# ---------------------------------------------------------------- one round of mutation, and the run


def plan_rounds(args):
    """Iterations of mutation in each round, the first rounds one more where they do not divide evenly; the steps of all.

    As many rounds as fit into the budget, each with its crossovers; refuses a budget that not even one fits into.
    """
    if args.population < 2:
        refuse(f"--population {args.population}: a couple needs at least 2 members; one policy is joint_baseline.py's")
    smallest = iteration_steps(args) + crossover_steps(args)
    rounds = min(args.rounds, args.total_timesteps // smallest)
    if rounds == 0:
        refuse(f"--total-timesteps {args.total_timesteps}: one round takes {smallest} steps; give at least that")
    iterations = (args.total_timesteps - rounds * crossover_steps(args)) // iteration_steps(args)
    plan = [iterations // rounds + (k < iterations % rounds) for k in range(rounds)]
    return plan, iterations * iteration_steps(args) + rounds * crossover_steps(args)


def iteration_steps(args):
    """Environment steps of one iteration of the whole population."""
    return args.population * args.num_envs * args.num_steps


def start_segment(args, envs, population, slots, segment):
    """Everything that starts afresh after a checkpoint, which thus need not hold it: nets' buffers, environments, episodes."""
    obs, _ = envs.reset(seed=sum([env_seeds(args.num_envs, args.seed, "reset", segment, slot) for slot in slots], []))
    members = SimpleNamespace(policy=make_policy(population.policies, args))
    members.critic = make_net(population.critics, critic_sizes(args))
    members.obs, members.open_episodes = obs.reshape(len(obs), -1), [[] for _ in obs]
    members.diverged = np.zeros(len(slots), bool)
    return members


def collect(args, envs, members, acting, stats, slots, segment, iteration):
    """One batch per local member: the roll-out, and per member the episodes that ended in it, as (obs, return)."""
    generators = [rng(args.seed, "noise", segment, iteration, slot) for slot in slots]
    noise = normal_noise(generators, args.num_steps, args.num_envs, args.act_dim)
    data = rollout(envs, members.obs, sample_actions(acting, stats, noise), args.num_steps)
    members.obs = data.last_obs
    members.diverged |= data.diverged.reshape(len(slots), -1).any(1)
    finished = finished_episodes(members.open_episodes, data)
    return data, [sum(finished[i * args.num_envs : (i + 1) * args.num_envs], []) for i in range(len(slots))]


@torch.no_grad()
def train_gpo(args, update_policies):
    """One worker's part of Algorithm 1; update_policies is the mutation's policy gradient."""
    slots = local_slots(args.population)
    n = len(slots)
    population = new_population(args, slots)
    run = open_run(args, population)
    envs = make_envs(args, n * args.num_envs)
    for generation in range(run.progress["segment"], len(args.plan)):
        members = start_segment(args, envs, population, slots, generation)
        policy, critic = members.policy, members.critic
        adam(policy), adam(critic)
        pools, recent = [deque() for _ in slots], [deque(maxlen=2) for _ in slots]
        warmup = min(args.critic_warmup, args.plan[generation] - 1) if generation > 0 else 0

        for iteration in range(args.plan[generation]):
            lap, stats = stopwatch(), statistics(population)
            data, episodes = collect(args, envs, members, policy, stats, slots, generation, iteration)
            for i in range(n):
                remember(args, pools[i], recent[i], episodes[i])
            lap("rollout")
            batches, (critic_obs, values, returns, advantages) = make_batches(args, data, policy, critic, stats)
            set_advantages(args, batches, advantages, advantages)
            moments = [batch_moments(*batch) for batch in zip(by_member(data.obs, n), returns)]
            lap("advantages")
            if iteration == 0:
                similar = similar_members(args, population, policy, batches, slots)
            learning = iteration >= warmup
            shared = share(batches) if args.data_sharing and learning else []
            lap("sharing")
            losses = kls = [0.0] * n
            if learning:
                sound = [bool((batch.log_probs + batch.advantages).isfinite().all()) for batch in shared]
                borrowed = [[shared[j] for j in similar[i] if sound[j]] for i in range(n)]
                losses, kls = update_policies(args, policy, batches, borrowed, population.kl_coefs)
            lap("policy_update")

            facts = [
                {
                    **member_facts(policy.rows[i], episodes[i], values[i], returns[i]),
                    "losses/policy_loss": losses[i],
                    "losses/approx_kl": kls[i],
                    "losses/kl_coef": population.kl_coefs[i].item(),
                    "sharing/size": len(similar[i]) + 1,
                }
                for i in range(n)
            ]
            gathered = gather(list(zip(facts, moments)))
            for i in range(n):  # the population shares its normalizer, because policies are compared on the same input
                update_statistics(args, population, i, [member_moments for _, member_moments in gathered])
            lap("statistics")
            targets = returns / statistics(population).return_rms[:, None]
            generators = [rng(args.seed, "critic_shuffle", generation, iteration, slot) for slot in slots]
            update_critics(args, critic, critic_obs, targets, generators)
            seconds = lap("critic_update")
            run.progress["global_step"] += iteration_steps(args)
            run.progress["seconds"] = time.perf_counter() - run.start
            scalars = iteration_scalars(args, run, [fact for fact, _ in gathered], seconds)
            scalars |= {f"sharing/size_{i}": fact["sharing/size"] for i, (fact, _) in enumerate(gathered)}
            run.log(scalars)
            show_iteration(args, run, scalars)

        fitness = [member_fitness(args, members, pools, recent, i) for i in range(n)]
        breed(args, run, generation, slots, population, policy, batches, np.array(gather(fitness)), pools)
        run.progress["segment"] += 1
        run.progress["seconds"] = time.perf_counter() - run.start
        save_checkpoint(args, run, population)
    envs.close()
    return close_run(args, run, population)


def remember(args, pool, recent, episodes):
    """Adds an iteration's episodes to a member's recent returns, and to its pool for pi_S, from which the oldest go."""
    recent.append([ret for _, ret in episodes])
    pool.extend(episodes)
    while len(pool) > 1 and sum(len(obs) for obs, _ in pool) - len(pool[0][0]) >= args.crossover_pool:
        pool.popleft()


def similar_members(args, population, policy, batches, slots):
    """S_i without i, per local member i: whose KL[pi_i, pi_j] is below the threshold before the round's mutation."""
    if not args.data_sharing:
        return [[] for _ in slots]
    everyone = gather_rows(population.policies)
    kl = [kl_row(row, batch.obs, everyone, args) for row, batch in zip(policy.rows, batches)]
    # NaN compares false: nobody borrows from a broken member
    return [[j for j in np.flatnonzero(kl[i] < args.kl_sharing_threshold) if j != slots[i]] for i in range(len(slots))]


def member_fitness(args, members, pools, recent, i):
    """Mean return of the episodes that ended in the last two iterations, else of the last that ended, else of the open ones.

    NaN if the member must not breed: not finite, or its simulation diverged. Fills an empty pool with the open episodes.
    """
    if not pools[i]:
        opened = [pieces for pieces in members.open_episodes[i * args.num_envs : (i + 1) * args.num_envs] if pieces]
        pools[i].extend(join_pieces(pieces) for pieces in opened)
        recent[i].append([ret for _, ret in pools[i]])
    finite = all(net.rows[i].flat.isfinite().all() for net in (members.policy, members.critic))
    if members.diverged[i] or not finite:
        return math.nan
    return float(np.mean(sum(recent[i], []) or pools[i][-1][1]))


def breed(args, run, generation, slots, population, policy, batches, fitness, pools):
    """Ends a round: select, crossover, comparison of children with parents. The children replace the population in place.

    policy: the mutated stack; batches: its last; fitness [m], pools: of everyone and of the local members.
    """
    lap, stats = stopwatch(), statistics(population)
    parents = SimpleNamespace(policies=gather_rows(population.policies), fitness=fitness)
    kl = np.stack(gather([kl_row(row, batch.obs, parents.policies, args) for row, batch in zip(policy.rows, batches)]))
    couples = select(args, generation, fitness, kl)
    lap("select")
    children, facts, pi_s = crossover(args, generation, slots, couples, parents, gather(pools), stats)
    lap("crossover")

    compare = (stats, f"comparison {generation}", args.comparison_episodes)
    parent_returns = gather(list(evaluate(args, policy, *compare).mean(1)))
    child_returns = gather(list(evaluate(args, make_policy(children, args), *compare).mean(1)))
    seconds = lap("comparison")

    heirs = [stronger(couples[slot], fitness) for slot in slots]  # a child's critic and beta are those of its stronger parent
    ids, facts, all_children = gather(population.ids.tolist()), gather(facts), gather_rows(children)
    all_pi_s = gather_rows(pi_s) if pi_s is not None else None
    population.policies = children
    population.critics, population.kl_coefs = gather_rows(population.critics)[heirs], gather_rows(population.kl_coefs)[heirs]
    population.ids = torch.tensor([args.population * (generation + 1) + slot for slot in slots])
    run.progress["global_step"] += crossover_steps(args)
    run.progress["evaluation_steps"] += 2 * args.population * evaluation_cost(args, args.comparison_episodes)

    lines = []
    for slot, (couple, fact) in enumerate(zip(couples, facts)):
        line = {"id": args.population * (generation + 1) + slot, "round": generation + 1, "slot": slot}
        line |= {"global_step": run.progress["global_step"], "parents": [ids[i] for i in couple]}
        line |= {"parent_fitness": [fitness[i] for i in couple], "parent_returns": [parent_returns[i] for i in couple]}
        lines.append({**line, "child_return": child_returns[slot], **fact})
    phases = [line.pop("seconds", {}) for line in lines]
    seconds |= {phase: max(p[phase] for p in phases) for phase in phases[0]}
    if world()[0] == 0:
        with open(run.folder / "lineage.jsonl", "a") as lineage:
            lineage.truncate(run.progress.get("lineage_bytes", 0))  # a round that was cut off had perhaps been written
            lineage.writelines(json.dumps(line) + "\n" for line in lines)
            lineage.flush()
            os.fsync(lineage.fileno())
            run.progress["lineage_bytes"] = os.path.getsize(run.folder / "lineage.jsonl")
        if generation == 0 or args.save_crossovers:
            content = {"format": 1, "flags": args.flags, "max_episode_steps": args.max_episode_steps, "round": generation + 1}
            content |= {"couples": couples, "ids": ids, "fitness": torch.from_numpy(fitness), "pi_s": all_pi_s}
            content |= {"parents": parents.policies, "children": all_children}
            content |= {"mean": torch.from_numpy(stats.mean[0]), "inv_std": torch.from_numpy(stats.inv_std[0])}
            save_atomically(content, run.folder / f"crossover_{generation + 1:03d}.pt")
    scalars = crossover_scalars(lines, kl, seconds)
    run.log(scalars)
    child, parent = scalars["crossover/child_return"], scalars["crossover/parent_return"]
    run.show(f"round {generation + 1}/{len(args.plan)} crossed over, children {child:.0f}, their parents {parent:.0f}")


def crossover_scalars(lines, kl, seconds):
    """What is logged after a crossover; lines: the round's part of lineage.jsonl; kl [m, m] among those who could breed."""
    child, parents = np.array([line["child_return"] for line in lines]), np.array([line["parent_returns"] for line in lines])
    names = ("pi_s_accuracy", "share_x", "expert_reward", "student_reward", "distillation_kl", "kl_to_parents")
    scalars = {f"crossover/{name}": float(np.mean([line[name] for line in lines])) for name in names if name in lines[0]}
    scalars["crossover/child_return"], scalars["crossover/parent_return"] = float(child.mean()), float(parents.mean())
    scalars["crossover/child_minus_best_parent"] = float((child - parents.max(1)).mean())
    scalars["population/diversity"] = float((kl.sum() - np.trace(kl)) / (kl.size - len(kl)))
    return {**scalars, **{f"time/{phase}": s for phase, s in seconds.items()}}


SCRIPT.update(segment="round", plan=plan_rounds, train=lambda args: train_gpo(args, ppo_update))


def main(argv=None):
    """Trains, on one worker in this process, on more through torch's launcher. Returns the content of evaluation.json."""
    argv = sys.argv[1:] if argv is None else argv
    args = parse_args(argv)
    if "TORCHELASTIC_RUN_ID" in os.environ:
        start_worker(args)
    else:
        lock(Path(args.run_dir) / args.run_name).close()
        if args.workers > 1:
            return launch(args, argv)
    torch.set_num_threads(1)
    try:
        return SCRIPT["train"](args)
    except KeyboardInterrupt:
        print(f"stopped; go on with --resume {Path(args.run_dir) / args.run_name}", file=sys.stderr)
        raise SystemExit(130) from None
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


if __name__ == "__main__":
    main()
