"""Learning rates of a scene of Gaussians."""

from dataclasses import dataclass

from foredrive.engine.learning_rates import Rate


@dataclass(frozen=True)
class LearningRates:
    """Rates of Adam for each kind of parameter of a `GaussianScene`."""

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
