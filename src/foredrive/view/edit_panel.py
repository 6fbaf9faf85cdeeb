"""The part of the page that edits a reconstructed scene: make, undo and save edits."""

import functools
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
import viser
from viser.transforms import SO3

from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import (
    Duplicate,
    Edit,
    EditedScene,
    Insert,
    Move,
    Remove,
    ShiftEgo,
    apply_edits,
    load_edits,
    move_between,
    save_edits,
    unused_id,
)
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.view.reconstruction_nodes import ROOT, ReconstructedNodes
from foredrive.view.reconstruction_video import describe_edit

NO_ACTOR = "none"
DUPLICATE_OFFSET_M = (0.0, 3.0, 0.0)
"""Offset of a copy from its original, m: one lane to the left."""
GIZMO_M = 5.0
RUNS_KEPT = 4


class EditPanel:
    """Controls of edits, and the gizmo that drags an actor.

    An edit that cannot be made shows a message and changes nothing.

    Args:
        server: server of the page.
        graph: the scene without edits; it is never changed.
        nodes: nodes of the scene; the chosen actor is highlighted and moves with the gizmo.
        file: default file for saved edits; the page can change it.
        tell: called with the message of a success or a failure.
        on_change: called after the scene has changed.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        graph: SceneGraph,
        nodes: ReconstructedNodes,
        file: Path,
        tell: Callable[[str], None],
        on_change: Callable[[], None],
    ) -> None:
        self._graph, self._nodes, self._tell, self._on_change = graph, nodes, tell, on_change
        self._open = functools.lru_cache(RUNS_KEPT)(lambda run: open_reconstruction(Path(run)).scene.graph)
        self.lock = threading.RLock()
        """Held while the scene is edited or drawn, because handlers of the page run in several threads.

        One lock for both: editing draws, and drawing shows the chosen actor. It is re-entrant.
        """
        self.edits: list[Edit] = []
        self.edited: EditedScene = apply_edits(graph, [])
        self._t_s = 0.0
        self._add_controls(server.gui, file)
        self.gizmo = server.scene.add_transform_controls(
            f"{ROOT}/gizmo",
            scale=GIZMO_M,
            active_axes=(True, True, False),  # Moves along the ground, and turns about the vertical
            depth_test=False,
            visible=False,
        )
        self.gizmo.on_update(lambda _: self._drag())
        self.gizmo.on_drag_end(lambda _: self.drop())

    @property
    def chosen(self) -> int | None:
        """Return the id of the edited actor; None: no actor is chosen."""
        return None if self.actor.value == NO_ACTOR else int(self.actor.value)

    def choose(self, track_id: int | None) -> None:
        """Choose an actor, or none."""
        self.actor.value = NO_ACTOR if track_id is None else str(track_id)
        self._show_chosen()

    def show(self, t_s: float) -> None:
        """Go to a time."""
        self._t_s = t_s
        self._show_chosen()

    def replace(self, edits: Sequence[Edit]) -> bool:
        """Replace the edits; return whether they can be made."""
        with self.lock:
            try:
                # All edits are applied to the unedited scene, so a failure leaves the present scene unchanged
                edited = apply_edits(self._graph, edits, self._open)
            except InputError as error:
                self._tell(str(error))
                return False
            self.edits, self.edited = list(edits), edited
            ids = sorted(edited.graph.tracks.track_id.tolist())
            kept = self.actor.value
            self.actor.options = (NO_ACTOR, *map(str, ids))
            self.actor.value = kept if kept in self.actor.options else NO_ACTOR
            self._list.content = "\n".join(f"1. {describe_edit(edit)}" for edit in self.edits) or "*no edits*"
            self.undo.disabled = not self.edits
        self._on_change()
        return True

    def add(self, edit: Edit) -> bool:
        """Make one more edit; return whether it can be made."""
        with self.lock:
            return self.replace([*self.edits, edit])

    def drop(self) -> None:
        """Leave the chosen actor at the pose of the gizmo."""
        with self.lock:
            if self.chosen is None:
                return
            tracks = self.edited.graph.tracks
            # The edit is the motion from the actor's present pose to that of the gizmo
            before = states_at(tracks, self._t_s).T_scene_actor[tracks.index_of(self.chosen)].detach().cpu()
            after = torch.eye(4)
            after[:3, :3] = torch.from_numpy(SO3(self.gizmo.wxyz).as_matrix()).float()
            after[:3, 3] = torch.from_numpy(np.asarray(self.gizmo.position)).float()
            self.add(move_between(self.chosen, before, after))

    def save(self) -> None:
        """Write the edits to the file that the page names."""
        path = Path(self.file.value)
        try:
            save_edits(self.edits, path)
        except InputError as error:
            self._tell(str(error))
        except OSError as error:
            self._tell(f"{path}: cannot be written: {error.strerror}")
        else:
            self._tell(f"{len(self.edits)} edits saved to {path}")

    def load(self) -> None:
        """Read edits from the file; they replace the present edits."""
        try:
            edits = load_edits(Path(self.file.value))
        except InputError as error:
            self._tell(str(error))
        else:
            self.replace(edits)

    def _add_controls(self, gui: viser.GuiApi, file: Path) -> None:
        ids = sorted(self._graph.tracks.track_id.tolist())
        with gui.add_folder("Edits"):
            self.actor = gui.add_dropdown(
                "actor", (NO_ACTOR, *map(str, ids)), hint="or click at one; then drag it by its arrows"
            )
            self.change = gui.add_button_group("change it", ("remove", "duplicate"))
            self.by = gui.add_vector3("move by", (0.0, 1.0, 0.0), hint="m ahead, m and degrees to the left")
            self.move = gui.add_button("Move actor")
            self.shift_m = gui.add_number("ego to the left, m", 2.0, step=0.5)
            self.shift = gui.add_button("Shift ego")
            with gui.add_folder("From another run", expand_by_default=False):
                self.source = gui.add_text("run's folder", "")
                self.source_id = gui.add_number("actor there", 0, min=0, step=1)
                self.insert = gui.add_button("Insert", hint="it drives beside the actor that is chosen here")
            self._list = gui.add_markdown("*no edits*")
            self.undo = gui.add_button("Undo", disabled=True)
            self.file = gui.add_text("file", str(file))
            self.keep = gui.add_button_group("edits", ("save", "load"))
        self.actor.on_update(lambda _: self._show_chosen())
        self.change.on_click(lambda _: self._change(self.change.value))
        self.move.on_click(lambda _: self._change("move"))
        self.shift.on_click(lambda _: self._shift())
        self.insert.on_click(lambda _: self._insert())
        self.undo.on_click(lambda _: self._undo())
        self.keep.on_click(lambda _: self.save() if self.keep.value == "save" else self.load())

    def _shift(self) -> None:
        self.add(ShiftEgo((0.0, float(self.shift_m.value), 0.0)))

    def _undo(self) -> None:
        self.replace(self.edits[:-1])

    def _change(self, how: str) -> None:
        if self.chosen is None:
            self._tell("choose an actor first: click at one, or take it from the list")
        elif how == "remove":
            self.add(Remove(self.chosen))
        elif how == "move":
            ahead_m, left_m, turn_deg = self.by.value
            self.add(Move(self.chosen, (ahead_m, left_m, 0.0), math.radians(turn_deg)))
        else:
            self._add_and_choose(Duplicate(self.chosen, unused_id(self.edited.graph), DUPLICATE_OFFSET_M))

    def _insert(self) -> None:
        if self.chosen is None:
            self._tell("choose the actor beside which the new one is to drive first")
            return
        copy, actor = unused_id(self.edited.graph), int(self.source_id.value)
        self._add_and_choose(
            Insert(self.source.value, actor, copy, follows=self.chosen, offset_m=DUPLICATE_OFFSET_M)
        )

    def _add_and_choose(self, edit: Duplicate | Insert) -> None:
        if self.add(edit):
            self.choose(edit.copy)

    def _show_chosen(self) -> None:
        with self.lock:
            chosen, tracks = self.chosen, self.edited.graph.tracks
            self._nodes.choose(chosen)
            states = states_at(tracks, self._t_s)
            row = None if chosen is None else tracks.index_of(chosen)
            self.gizmo.visible = row is not None and bool(states.present[row])
            if row is not None:
                pose = states.T_scene_actor[row].detach().double().cpu().numpy()
                self.gizmo.wxyz, self.gizmo.position = SO3.from_matrix(pose[:3, :3]).wxyz, pose[:3, 3]

    def _drag(self) -> None:
        if self.chosen is not None:
            self._nodes.move(self.chosen, self.gizmo.wxyz, self.gizmo.position)
