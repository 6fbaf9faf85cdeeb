"""A tree of frames whose poses change over time, as tf messages state them."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64, Int64

from foredrive.data.ego_path import interpolated_poses
from foredrive.data.formats.bag_messages import Placed
from foredrive.data.notices import note
from foredrive.errors import InputError


class FrameTree:
    """Poses of frames in their parents, interpolated between messages.

    A frame with one pose is fixed to its parent. Before its first and after its last pose, a frame stays at
    that pose.
    """

    def __init__(self, placed: Iterable[Placed]) -> None:
        self._parent: dict[str, str] = {}
        poses: dict[str, dict[int, np.ndarray]] = {}
        for one in placed:
            if one.child == one.parent:
                continue
            # The first parent of a frame stays; poses in another parent are left out
            parent = self._parent.setdefault(one.child, one.parent)
            if parent == one.parent:
                poses.setdefault(one.child, {})[one.t_us] = one.T_parent_child
            else:
                place = f"{one.child} in {one.parent}, at {one.t_us * 1e-6:.3f} s"
                note("transforms", f"second parents of a frame, beside {parent}, left out", place)
        # Poses of each frame in order of time; of two at one time the later message counts
        self._times = {child: np.array(sorted(stamped), np.int64) for child, stamped in poses.items()}
        self._poses = {
            child: np.stack([poses[child][t_us] for t_us in times.tolist()])
            for child, times in self._times.items()
        }

    @property
    def frames(self) -> set[str]:
        """Return the names of all frames."""
        return set(self._parent) | set(self._parent.values())

    def is_below(self, frame: str, top: str) -> bool:
        """Return whether a frame is attached to another, over any number of frames."""
        return frame != top and top in {self._parent[one] for one in self._chain(frame)}

    def span_us(self, top: str, frame: str) -> tuple[int, int]:
        """Return the times between which all moving frames from `frame` up to `top` have poses."""
        # Frames with a single pose are fixed and have no span
        moving = [self._times[one] for one in self._chain(frame, top) if len(self._times[one]) > 1]
        if not moving:
            raise InputError(f"the frame {frame!r} does not move in {top!r}: poses of the vehicle are needed")
        return int(max(times[0] for times in moving)), int(min(times[-1] for times in moving))

    def times_us(self, top: str, frame: str) -> Int64[np.ndarray, "P"]:
        """Return all times at which a frame from `frame` up to `top` has a pose, within `span_us`."""
        low, high = self.span_us(top, frame)
        times = np.unique(np.concatenate([self._times[one] for one in self._chain(frame, top)]))
        return times[(times >= low) & (times <= high)]

    def pose(self, top: str, frame: str, t_us: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Return the poses of a frame in one of its ancestors.

        Raises:
            InputError: `top` is not above `frame`.
        """
        T = np.tile(np.eye(4), (len(t_us), 1, 1))
        # From the frame up: each pose is multiplied from the left
        for one in self._chain(frame, top):
            times, poses = self._times[one], self._poses[one]
            T = (poses[0] if len(times) == 1 else interpolated_poses(times, poses, t_us)) @ T
        return T

    def between(self, first: str, second: str, t_us: int) -> Float64[np.ndarray, "4 4"]:
        """Return T_first_second at one time, over their common root."""
        roots = [self._root(first), self._root(second)]
        if roots[0] != roots[1]:
            raise InputError(f"the frames {first!r} and {second!r} are not connected by transforms")
        time_us = np.array([float(t_us)])
        T_root_first, T_root_second = (self.pose(roots[0], name, time_us)[0] for name in (first, second))
        return np.asarray(np.linalg.inv(T_root_first) @ T_root_second)

    def _root(self, frame: str) -> str:
        chain = self._chain(frame)
        return self._parent[chain[-1]] if chain else frame

    def _chain(self, frame: str, top: str | None = None) -> list[str]:
        """Return the frames from `frame` up to the one below `top`, or below the root."""
        chain: list[str] = []
        while frame != top and frame in self._parent:
            # A frame that comes up again shows a circle
            if frame in chain:
                raise InputError(f"the transforms of {frame!r} go in a circle")
            chain.append(frame)
            frame = self._parent[frame]
        if top is not None and frame != top:
            raise InputError(
                f"the frame {chain[0] if chain else frame!r} is not below {top!r}: it ends at {frame!r}"
            )
        return chain
