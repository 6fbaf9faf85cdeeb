"""Learning rates of a scene of Gaussians over the steps of a training."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Rate:
    """A learning rate that rises as the first quarter of a sine, then decays exponentially."""

    first: float
    """Rate after the warm-up; 0 keeps the parameters as they are."""
    final: float = 0.1
    """Rate at the end, as a fraction of `first`."""
    warmup_steps: int = 0
    until_step: int | None = None
    """Step of the final rate, which stays until the end; None: the last step of the training."""

    def at(self, step: int, steps: int) -> float:
        """Return the rate at a step of a training of `steps` steps."""
        if step < self.warmup_steps:
            return self.first * math.sin(0.5 * math.pi * step / self.warmup_steps)
        decaying = max((self.until_step or steps) - self.warmup_steps, 1)
        return self.first * float(self.final ** min((step - self.warmup_steps) / decaying, 1.0))


@dataclass(frozen=True)
class LearningRates:
    """Rates of Adam for each kind of parameter of a `RebuiltScene`."""

    mean_m: Rate = Rate(1.6e-4, final=0.01)
    quaternion: Rate = Rate(1e-3)
    log_scale: Rate = Rate(5e-3)
    opacity_logit: Rate = Rate(5e-2)
    albedo: Rate = Rate(2.5e-3)
    feature: Rate = Rate(2.5e-3)
    decoders: Rate = Rate(1e-3)
    actor_offset: Rate = Rate(1e-4)
    camera_offset: Rate = Rate(1e-5)
    camera_twist: Rate = Rate(1e-4)
    camera_late_s: Rate = Rate(1e-5)
    frame_velocity: Rate = Rate(0.0)
    frame_turn: Rate = Rate(0.0)
