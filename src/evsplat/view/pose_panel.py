"""Controls of the person's motion: motions that ship, and sliders per group of joints."""

import functools
from collections.abc import Callable
from itertools import groupby

import viser

from evsplat.staging.assets import motions
from evsplat.view.client import Client

_RECORDED = "as recorded"


class PosePanel:
    """A choice of motions, and angles on top of the one that is chosen."""

    def __init__(self, client: Client, show_motion: Callable[[str | None], None]) -> None:
        """Build the controls in the folder that is open; ``show_motion`` runs between pictures."""
        self.client = client
        gui = client.handle.gui
        names = {_RECORDED: None, **{name.replace("_", " "): name for name in motions()}}
        motion = gui.add_dropdown("Motion", tuple(names))
        self.sliders = []
        groups = groupby(self.client.painter.subject.sliders, lambda slider: slider.group)
        for group, members in groups:
            with gui.add_folder(group, expand_by_default=False):
                for member in members:
                    limit = float(member.limit)
                    slider = gui.add_slider(f"{member.label}, \u00b0", -limit, limit, 1.0, 0.0)
                    slider.on_update(self._turned)
                    self.sliders.append(slider)
        reset = gui.add_button("Pose as in the motion", icon=viser.Icon.RESTORE)
        reset.visible = bool(self.sliders)

        async def chosen(_: viser.GuiEvent) -> None:
            job = functools.partial(show_motion, names[motion.value])
            self.client.scheduler.do(job)

        async def straightened(_: viser.GuiEvent) -> None:
            for slider in self.sliders:
                # viser's property has a setter, which type checkers do not see.
                slider.value = 0.0  # type: ignore[misc]

        motion.on_update(chosen)
        reset.on_click(straightened)

    async def _turned(self, _: viser.GuiEvent) -> None:
        angles = tuple(slider.value for slider in self.sliders)
        self.client.move(angles=angles)
