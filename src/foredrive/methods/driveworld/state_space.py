"""DriveWorld's Memory State-Space Model without its planes: latent dynamics in vectors (§3.1, eq. 1–2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.methods.driveworld.gaussian import DiagonalGaussian
from foredrive.scene.record import Record

ACTIONS = 2
"""Number of action channels: velocity (m/s) and steering angle (rad) of the bicycle."""


@dataclass(frozen=True, kw_only=True)
class StateSpaceConfig:
    """Sizes of a `StateSpace`."""

    observation: int
    """Width of x_t (512 in the paper)."""
    state: int
    """S, width of the stochastic state (512 in MILE)."""
    history: int
    """H, width of the deterministic history (1024 in MILE)."""
    memory: int
    """M, number of histories held by the Dynamic Memory Bank."""
    heads: int
    """Heads of the attention to the memory."""
    objects: int
    """K, number of moving objects whose velocities are estimated."""
    hidden: int
    """Width of the MLPs."""
    action: int = 64
    """Width of the encoding of an action."""
    memory_bank: bool = True
    """Attend to the memory. If False, h̃ is h."""
    motion_norm: bool = True
    """Use motion-aware layer normalisation. If False, s̃ is s."""
    min_std: float = 0.1
    """Minimum standard deviation of a state. It keeps the divergence between two states finite, as in
    MILE."""
    speed_scale_mps: float = 10.0
    """Scale of speeds, m/s: inputs are divided by it and outputs multiplied by it."""
    steering_scale_rad: float = 0.1
    """Scale of steering, rad: inputs are divided by it and outputs multiplied by it."""


@dataclass(frozen=True)
class Latent(Record):
    """The latent state that the model carries from one time to the next."""

    history: Float[Tensor, "b H"]
    """h_t, deterministic."""
    state: Float[Tensor, "b S"]
    """s_t, stochastic."""
    memory: Float[Tensor, "b M H"]
    """h_1 … h_t, newest last. Only the last M are kept."""
    memory_valid: Bool[Tensor, "b M"]
    """True for the filled places of the memory."""


class MotionAwareNorm(nn.Module):
    """Normalisation s̃ = γ ⊙ LN(s) + β, with γ, β from the velocities of K objects and the time step (§3.1).

    As in StreamPETR (Wang et al. 2023) it starts as plain normalisation: γ = 1, β = 0.

    Args:
        state: S.
        objects: K.
        speed_scale_mps: scale by which velocities are divided.
    """

    def __init__(self, state: int, objects: int, speed_scale_mps: float) -> None:
        super().__init__()
        self.speed_scale_mps = speed_scale_mps
        self.norm = nn.LayerNorm(state, elementwise_affine=False)
        self.reduce = nn.Sequential(nn.Linear(2 * objects + 1, state), nn.ReLU())
        self.gamma, self.beta = nn.Linear(state, state), nn.Linear(state, state)
        # Zero weights and these biases make γ = 1 and β = 0 at the start
        for layer, bias in ((self.gamma, 1.0), (self.beta, 0.0)):
            nn.init.zeros_(layer.weight)
            nn.init.constant_(layer.bias, bias)

    def forward(
        self, state: Float[Tensor, "b S"], velocity_mps: Float[Tensor, "b K 2"], dt_s: Float[Tensor, "b"]
    ) -> Float[Tensor, "b S"]:
        """Return the motion-aware state."""
        scaled = velocity_mps.flatten(1) / self.speed_scale_mps
        motion = self.reduce(torch.cat([scaled, dt_s[:, None]], dim=-1))
        return self.gamma(motion) * self.norm(state) + self.beta(motion)


class MemoryAttention(nn.Module):
    """The history refined by attention to the whole memory: h̃_t (§3.1).

    Args:
        history: H.
        heads: attention heads.
    """

    def __init__(self, history: int, heads: int) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(history, heads, batch_first=True)
        self.norm = nn.LayerNorm(history)

    def forward(self, latent: Latent) -> Float[Tensor, "b H"]:
        """Return the refined history."""
        query = latent.history[:, None]
        # The query is the history of now; places of the memory that are not filled are masked
        attended, _ = self.attention(
            query, latent.memory, latent.memory, key_padding_mask=~latent.memory_valid, need_weights=False
        )
        return self.norm(query + attended)[:, 0]


class StateSpace(nn.Module):
    """Posterior, prior, policy and transition of the latent dynamics.

    The paper does not say where the velocities of the K objects come from. Here they are estimated from s_t,
    so that they exist in imagination too. They are learned from labelled boxes where there are any.

    Args:
        config: sizes.
    """

    def __init__(self, config: StateSpaceConfig) -> None:
        super().__init__()
        history, state, objects = config.history, config.state, config.objects
        observation, action, hidden = config.observation, config.action, config.hidden
        self.sizes = (history, state, config.memory)
        self.objects, self.min_std, self.speed_scale_mps = objects, config.min_std, config.speed_scale_mps
        self.action_in = nn.Linear(ACTIONS, action)
        self.posterior_net = _mlp(history + action + observation, hidden, 2 * state)
        self.prior_net = _mlp(history + action, hidden, 2 * state)
        self.policy = _mlp(history + state, hidden, ACTIONS)
        self.velocity = nn.Linear(state, 2 * objects)
        self.motion_norm = (
            MotionAwareNorm(state, objects, config.speed_scale_mps) if config.motion_norm else None
        )
        self.recall = MemoryAttention(history, config.heads) if config.memory_bank else None
        self.into = nn.Sequential(nn.Linear(state, history), nn.LeakyReLU())
        self.cell = nn.GRUCell(history, history)
        action_scale = torch.tensor([config.speed_scale_mps, config.steering_scale_rad])
        self.register_buffer("action_scale", action_scale, persistent=False)

    action_scale: Tensor

    def initial(self, batch: int, device: torch.device) -> Latent:
        """Return the initial latent: h_1 = 0, and a memory that holds only h_1."""
        history, state, memory = self.sizes
        zeros = torch.zeros(batch, history, device=device)
        latent = Latent(
            history=zeros,
            state=torch.zeros(batch, state, device=device),
            memory=torch.zeros(batch, memory, history, device=device),
            memory_valid=torch.zeros(batch, memory, dtype=torch.bool, device=device),
        )
        return _with_history(latent, zeros)

    def transition(self, latent: Latent, dt_s: Float[Tensor, "b"]) -> Latent:
        """Return the latent with h_{t+1} = f(h̃_t, s̃_t), added to the memory. The state stays s_t."""
        # Motion-aware state s̃ and refined history h̃; both are optional in ablations
        state = latent.state
        if self.motion_norm is not None:
            state = self.motion_norm(state, self.velocities_mps(state), dt_s)
        refined = latent.history if self.recall is None else self.recall(latent)
        # The GRU's input is the state, its hidden state the history
        return _with_history(latent, self.cell(self.into(state), refined))

    def posterior(
        self, latent: Latent, last_action: Float[Tensor, "b 2"], x: Float[Tensor, "b X"]
    ) -> DiagonalGaussian:
        """Return q(s_t | o_≤t, a_<t) from (h_t, a_{t-1}, x_t) (eq. 1)."""
        # Actions enter in units of their scales
        inputs = torch.cat([latent.history, self.action_in(last_action / self.action_scale), x], dim=-1)
        return DiagonalGaussian.from_output(self.posterior_net(inputs), self.min_std)

    def prior(self, latent: Latent, last_action: Float[Tensor, "b 2"]) -> DiagonalGaussian:
        """Return p(s_t | h_{t-1}, s_{t-1}) from (h_t, â_{t-1}) (eq. 2)."""
        inputs = torch.cat([latent.history, self.action_in(last_action / self.action_scale)], dim=-1)
        return DiagonalGaussian.from_output(self.prior_net(inputs), self.min_std)

    def action(self, latent: Latent) -> Float[Tensor, "b 2"]:
        """Return â_t = π(h_t, s_t): velocity (m/s) and steering angle (rad)."""
        return self.policy(torch.cat([latent.history, latent.state], dim=-1)).float() * self.action_scale

    def velocities_mps(self, state: Float[Tensor, "b S"]) -> Float[Tensor, "b K 2"]:
        """Return estimated velocities over ground (m/s, ego axes) of the K nearest moving objects."""
        return self.velocity(state).unflatten(-1, (self.objects, 2)).float() * self.speed_scale_mps


def _with_history(latent: Latent, history: Float[Tensor, "b H"]) -> Latent:
    """Return the latent with a new history, which is added to the memory."""
    valid = torch.ones_like(latent.memory_valid[:, :1])
    return Latent(
        history=history,
        state=latent.state,
        # First in, first out: the oldest history leaves the memory
        memory=torch.cat([latent.memory[:, 1:], history[:, None].to(latent.memory)], dim=1),
        memory_valid=torch.cat([latent.memory_valid[:, 1:], valid], dim=1),
    )


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.LeakyReLU(),
        nn.Linear(hidden, hidden),
        nn.LeakyReLU(),
        nn.Linear(hidden, outputs),
    )
