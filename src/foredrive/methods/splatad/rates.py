"""Learning rates of a scene of Gaussians."""

from dataclasses import dataclass

from foredrive.engine.learning_rates import Rate


@dataclass(frozen=True)
class LearningRates:
    """Rates of Adam for each kind of parameter of a `GaussianScene`."""

    mean_m: Rate = Rate(1.6e-4, final=0.01)
    """Rate of the centres."""
    quaternion: Rate = Rate(1e-3)
    """Rate of the rotations."""
    log_scale: Rate = Rate(5e-3)
    """Rate of the logarithms of the standard deviations."""
    opacity_logit: Rate = Rate(5e-2)
    """Rate of the logits of the opacities."""
    albedo: Rate = Rate(2.5e-3)
    """Rate of the albedos."""
    feature: Rate = Rate(2.5e-3)
    """Rate of the features besides albedo."""
    decoders: Rate = Rate(1e-3)
    """Rate of the decoders of images and of beams."""
    deformation: Rate = Rate(1e-3)
    """Rate of the shapes of people, if they are learned."""
    actor_offset: Rate = Rate(1e-4)
    """Rate of the offsets of the actors' poses."""
    camera_offset: Rate = Rate(1e-5)
    """Rate of the offsets of the cameras' mounts."""
    camera_twist: Rate = Rate(1e-4)
    """Rate of the corrections of the cameras' velocities and turn rates."""
    camera_late_s: Rate = Rate(1e-5)
    """Rate of the delays of the cameras' exposures."""
    frame_velocity: Rate = Rate(0.0)
    """Rate of the corrections of the velocities of training images and sweeps."""
    frame_turn: Rate = Rate(0.0)
    """Rate of the corrections of the turn rates of training images and sweeps."""
