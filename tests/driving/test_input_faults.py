"""Cameras that fail and noise on what an agent is told."""

import dataclasses

import pytest
import torch
from small_drives import one_example

from foredrive.driving.faults import CameraFault, Faults, read_camera_fault
from foredrive.driving.faulty_agent import FaultyAgent
from foredrive.errors import InputError
from foredrive.scene import Clip, Trajectory


class Keeper:
    """Keeps what it was shown."""

    def __init__(self) -> None:
        self.seen: list[Clip] = []

    def act(self, observation: Clip) -> Trajectory:
        self.seen.append(observation)
        return observation.future


def shown(faults: Faults, plans: int = 4, seed: int = 0) -> tuple[list[Clip], list[Clip]]:
    """What an agent sees and what there was: clips of three frames, half a second apart."""
    keeper = Keeper()
    agent = FaultyAgent(keeper, faults, 0.5, f"drive{seed}")
    clips = []
    for k in range(plans):
        clip = one_example(k).clip.observed()
        clips.append(dataclasses.replace(clip, route_valid=torch.ones(1, 7, dtype=torch.bool)))
        agent.act(clips[-1])
    return keeper.seen, clips


def test_a_lost_camera_is_masked_from_its_time_on() -> None:
    seen, clips = shown(Faults(cameras=(CameraFault("lost", "RIGHT", 1.0),)))
    assert [s.image_valid[0, -1].tolist() for s in seen] == [[True, True]] * 2 + [[True, False]] * 2
    assert seen[2].image_valid[0, :, 1].tolist() == [True, True, False]
    assert seen[3].image_valid[0, :, 1].tolist() == [True, False, False]
    assert not seen[3].images[0, -1, 1].any()
    torch.testing.assert_close(seen[3].images[:, :, 0], clips[3].images[:, :, 0])


def test_a_black_camera_counts_as_an_image() -> None:
    seen, _ = shown(Faults(cameras=(CameraFault("black", "left"),)))
    assert all(bool(s.image_valid.all()) for s in seen)
    assert not any(s.images[0, -1, 0].any() for s in seen)


def test_a_frozen_camera_repeats_the_image_before() -> None:
    seen, clips = shown(Faults(cameras=(CameraFault("frozen", "left", 1.0),)))
    torch.testing.assert_close(seen[1].images, clips[1].images)
    last = clips[2].images[0, 1, 0]  # at 0.5 s, as the clip at 1 s has it
    torch.testing.assert_close(seen[2].images[0, 2, 0], last)
    torch.testing.assert_close(seen[3].images[0, 2, 0], clips[3].images[0, 0, 0])


def test_a_halved_camera_shows_every_second_image_twice() -> None:
    keeper, generator = Keeper(), torch.Generator().manual_seed(0)
    agent = FaultyAgent(keeper, Faults(cameras=(CameraFault("halved", "left", 1.0),)), 0.5, "drive")
    clip = one_example(0).clip.observed()
    truth = torch.randint(0, 256, (8, *clip.images.shape[2:]), generator=generator, dtype=torch.uint8)
    for k in range(6):  # key frames k - 2 to k of the drive
        agent.act(dataclasses.replace(clip, images=truth[k : k + 3][None]))
    for k, seen in enumerate(keeper.seen):
        for frame, number in enumerate(range(k - 2, k + 1)):
            repeated = number >= 3 and number % 2 == 1
            torch.testing.assert_close(seen.images[0, frame, 0], truth[number + 2 - repeated, 0])
        torch.testing.assert_close(seen.images[0, :, 1], truth[k : k + 3, 1])
        assert bool(seen.image_valid.all())


def test_noise_has_its_size_and_a_key_frame_keeps_it() -> None:
    seen, clips = shown(Faults(speed_noise_mps=0.5, position_noise_m=2.0), plans=60)
    error = torch.stack([s.ego_speed_mps - c.ego_speed_mps for s, c in zip(seen, clips, strict=True)])[:, 0]
    assert 0.3 < float(error[:, -1].std()) < 0.7
    torch.testing.assert_close(error[4, 1], error[3, 2], atol=1e-5, rtol=0)
    moved = torch.stack([s.route_xy - c.route_xy for s, c in zip(seen, clips, strict=True)])
    assert 1.3 < float(moved.std()) < 2.7
    again, _ = shown(Faults(speed_noise_mps=0.5, position_noise_m=2.0), plans=3)
    torch.testing.assert_close(again[2].ego_speed_mps, seen[2].ego_speed_mps)


def test_a_camera_that_the_agent_does_not_read_changes_nothing() -> None:
    seen, clips = shown(Faults(cameras=(CameraFault("black", "PCAM_B0"),)))
    torch.testing.assert_close(seen[0].images, clips[0].images)


@pytest.mark.parametrize("text", ["dark:PCAM_F0", "black", "black:PCAM_F0@soon", "lost:PCAM_F0@-1"])
def test_a_fault_of_another_form_is_one_line(text: str) -> None:
    with pytest.raises(InputError, match="--camera-fault"):
        read_camera_fault(text)


def test_faults_are_read() -> None:
    assert read_camera_fault("black:PCAM_F0@2.5") == CameraFault("black", "PCAM_F0", 2.5)
    assert read_camera_fault("lost:PCAM_F0") == CameraFault("lost", "PCAM_F0", 0.0)
    with pytest.raises(InputError, match="at least 0"):
        Faults(speed_noise_mps=-1.0)
