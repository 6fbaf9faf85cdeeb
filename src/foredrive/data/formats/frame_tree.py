"""A tree of frames whose poses change over time, as tf messages state them."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from foredrive.data.ego_path import in_holes, interpolated_poses
from foredrive.data.formats.bag_messages import Placed
from foredrive.data.notices import note
from foredrive.errors import InputError

_EQUAL = 1e-6
"""Largest difference of the entries of equal poses."""


class FrameTree:
    """Poses of frames in their parents, interpolated between messages.

    A frame is fixed to its parent if a fixed pose says so, if it has one pose, or if all of its poses are
    equal. Before its first and after its last pose, a frame stays at that pose.
    """

    def __init__(self, placed: Iterable[Placed]) -> None:
        self._parent: dict[str, str] = {}
        poses: dict[str, dict[int, np.ndarray]] = {}
        fixed: dict[str, np.ndarray] = {}
        for one in placed:
            if one.child == one.parent:
                continue
            # The first parent of a frame stays; poses in another parent are left out
            parent = self._parent.setdefault(one.child, one.parent)
            if parent != one.parent:
                place = f"{one.child} in {one.parent}, at {one.t_us * 1e-6:.3f} s"
                note("transforms", f"second parents of a frame, beside {parent}, left out", place)
            elif one.fixed:
                before = fixed.get(one.child)
                if before is not None and not np.allclose(before, one.T_parent_child, atol=_EQUAL):
                    note("transforms", "fixed ones that change; the last holds", f"{one.child} in {parent}")
                fixed[one.child] = one.T_parent_child
            else:
                poses.setdefault(one.child, {})[one.t_us] = one.T_parent_child
        # Poses of each frame in order of time; of two at one time the later message counts
        self._times = {child: np.array(sorted(stamped), np.int64) for child, stamped in poses.items()}
        self._poses = {
            child: np.stack([poses[child][t_us] for t_us in times.tolist()])
            for child, times in self._times.items()
        }
        self._still = {
            child for child, T in self._poses.items() if np.allclose(T, T[:1], rtol=0, atol=_EQUAL)
        }
        for child, T in fixed.items():
            if child in self._poses and child not in self._still:
                note(
                    "transforms",
                    "fixed ones of frames that move, left out",
                    f"{child} in {self._parent[child]}",
                )
                continue
            self._times[child], self._poses[child] = np.zeros(1, np.int64), T[None]
            self._still.add(child)

    @property
    def frames(self) -> set[str]:
        """Return the names of all frames."""
        return set(self._parent) | set(self._parent.values())

    def is_below(self, frame: str, top: str) -> bool:
        """Return whether a frame is attached to another, over any number of frames."""
        return frame != top and top in {self._parent[one] for one in self._chain(frame)}

    def moves(self, first: str, second: str) -> bool:
        """Return whether one of two frames moves in the other."""
        chains = [set(self._chain(frame)) for frame in (first, second)]
        return not (chains[0] ^ chains[1]) <= self._still

    def span_us(self, top: str, frame: str) -> tuple[int, int]:
        """Return the times between which all moving frames from `frame` up to `top` have poses."""
        chain = self._chain(frame, top)
        # Fixed frames have no span. All poses of a vehicle that stands are equal, so they are looked at last
        moving = [self._times[one] for one in chain if one not in self._still]
        moving = moving or [self._times[one] for one in chain if len(self._times[one]) > 1]
        if not moving:
            raise InputError(f"the frame {frame!r} does not move in {top!r}: poses of the vehicle are needed")
        return int(max(times[0] for times in moving)), int(min(times[-1] for times in moving))

    def holes(self, top: str, frame: str, t_us: Int64[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
        """Return which times lie in a hole of the poses from `frame` up to `top` (`ego_path.in_holes`)."""
        inside = np.zeros(len(t_us), bool)
        for one in self._chain(frame, top):
            inside |= in_holes(self._times[one], self._poses[one], t_us)
        return inside

    def times_us(self, top: str, frame: str) -> Int64[np.ndarray, "P"]:
        """Return all times at which a frame from `frame` up to `top` has a pose, within `span_us`."""
        low, high = self.span_us(top, frame)
        moving = [self._times[one] for one in self._chain(frame, top) if len(self._times[one]) > 1]
        times = np.unique(np.concatenate(moving))
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
            T = (poses[0] if one in self._still else interpolated_poses(times, poses, t_us)) @ T
        return T

    def between(self, first: str, second: str, t_us: Int64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Return T_first_second at times, over their common root."""
        roots = [self._root(first), self._root(second)]
        if roots[0] != roots[1]:
            raise InputError(f"the frames {first!r} and {second!r} are not connected by transforms")
        T_root_first, T_root_second = (
            self.pose(roots[0], name, t_us.astype(np.float64)) for name in (first, second)
        )
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
