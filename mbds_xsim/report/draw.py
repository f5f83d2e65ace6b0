"""Picture of a scene: particles, bodies, joints, springs, fixed points, direction of gravity.

Everything is projected orthographically onto one plane: a scene that lies in a coordinate plane is
seen straight on, any other from above its front corner. Symbols scale with the picture; positions,
ellipsoids and contact spheres scale with the scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.text import counted, in_figure
from mbds_xsim.report import themed
from mbds_xsim.report.blocks import Figure
from mbds_xsim.report.catalogue import scene_row
from mbds_xsim.report.motion import Projection, Skeleton, outline, pose_of, skeleton
from mbds_xsim.report.themed import DRAWN, PALE, PARTS, Draw
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair
from mbds_xsim.scene.scene import Scene

_FAINT = "#cfd5da"
_BODY = "#6f8296"
_NAMED_BODIES = 12
_LABEL = {"fontsize": 8, "color": DRAWN, "zorder": 9}


def draw_scene(scene: Scene, path: Path, *, start: int | None = None) -> None:
    """Draw a scene into a PNG file, at a trajectory's start, or else in the reference pose.

    Raises:
        InputError: The file cannot be written.
    """
    draw, size = _drawing(scene, start)
    write_whole(path, themed.picture(draw, size, None))


def scene_figure(scene: Scene) -> Figure:
    """Return a drawing of a scene in its reference pose for a page."""
    draw, size = _drawing(scene, None)

    def on_white(figure: Any) -> None:
        import matplotlib
        from matplotlib.patches import Rectangle

        figure.set_layout_engine("none")  # the drawing fills it
        # Its colours are for white, and the page may be dark.
        figure.add_artist(Rectangle((0, 0), 1, 1, zorder=-1, color="white"))
        with matplotlib.rc_context(themed.ON_WHITE):
            draw(figure)

    return Figure(f"{scene.name} at its reference pose", on_white, size, wide=True)


def _drawing(scene: Scene, start: int | None) -> tuple[Draw, tuple[float, float]]:
    """Return a function that draws a scene on a figure, and the size that fits [in]."""
    picture = _Picture.of(scene, start)

    def draw(figure: Any) -> None:
        picture.paint(figure.add_axes((0.0, 0.0, 1.0, 1.0)))
        _title(figure, scene, start)

    return draw, picture.inches()


@dataclass(frozen=True, eq=False)
class _Picture:
    """Scene in one pose, with the view and the size of its symbols."""

    mechanism: Mechanism
    bones: Skeleton
    pose: BodyStates
    view: Projection
    points: Array
    """Moving points of the skeleton in W, shape (point, 3)."""
    low: Array
    high: Array
    unit: float
    """Radius of the heaviest particle [m]."""

    @staticmethod
    def of(scene: Scene, start: int | None) -> _Picture:
        mechanism, bones = Mechanism.of(scene), skeleton(scene)
        pose = pose_of(mechanism, start)
        world, points = pose.with_world(), pose.points(bones.body, bones.offset)
        lines = (*mechanism.distances, *mechanism.springs)
        ends = [world.points(list(pair.bodies), np.array(pair.in_body)) for pair in lines]
        anchors = [world.points([joint.child], joint.in_child) for joint in mechanism.joints]
        solid = np.concatenate([points, bones.fixed, *anchors, *ends, pose.position])
        view = Projection.of(solid, scene.dimension)
        reach = np.concatenate([np.maximum(bones.radius, 0.0), np.zeros(len(solid) - len(points))])
        flat = view.flat(solid)
        low, high = (flat - reach[:, None]).min(axis=0), (flat + reach[:, None]).max(axis=0)
        for body in np.flatnonzero(mechanism.particles_per_body == 0).tolist():
            center, half = view.flat(pose.position[body]), outline(mechanism, pose, view, body)
            size = np.sqrt(np.maximum(np.diag(half), 0.0))  # a flat body's is 0 but for rounding
            low, high = np.minimum(low, center - size), np.maximum(high, center + size)
        extent = max(float((high - low).max()), 0.3 * scene.length)
        return _Picture(mechanism, bones, pose, view, points, low, high, 0.013 * extent)

    def inches(self) -> tuple[float, float]:
        """Return a size [in] that fits the shape of the scene, within reason."""
        width, height = self.high - self.low + 16.0 * self.unit
        scale = 6.2 / max(width, height)
        return max(6.0, width * scale), max(4.5, height * scale + 1.0)

    def paint(self, axes: Any) -> None:
        """Draw the whole picture."""
        axes.set_axis_off()
        axes.set_aspect("equal", adjustable="datalim")
        pad = 8.0 * self.unit
        width, height = self.inches()
        low, high = self.low - pad, self.high + pad
        # The title takes the top inch, the scale bar the margin below.
        high[1] += (high[1] - low[1]) * 0.8 / max(height - 1.0, 1.0)
        center, span = 0.5 * (low + high), high - low
        span = np.maximum(span, span[::-1] * [width / height, height / width])
        axes.set_xlim(center[0] - span[0] / 2, center[0] + span[0] / 2)
        axes.set_ylim(center[1] - span[1] / 2, center[1] + span[1] / 2)
        self._ground(axes)
        self._bodies(axes)
        self._skeleton(axes)
        for spring in self.mechanism.springs:
            self._spring(axes, spring)
        for link in self.mechanism.distances:
            ends = self.view.flat(self._ends(link))
            look = {"color": PARTS["distance link"], "label": "distance link"}
            axes.plot(*ends.T, linewidth=1.8, zorder=5, **look)
        for joint in self.mechanism.joints:
            self._joint(axes, joint)
        self._center(axes)
        self._names(axes)
        self._scale_bar(axes)
        self._directions(axes)
        self._legend(axes)

    def _ground(self, axes: Any) -> None:
        if self.mechanism.scene.ground is None:
            return
        if self.view.axes[1, 2] > 0.999:
            if axes.get_ylim()[0] < 0.0:
                axes.axhspan(-1.5 * self.unit, 0.0, color=_FAINT, lw=0, zorder=0, label="ground")
            return
        across, margin = self.points[:, :2], 4.0 * self.unit
        (left, front), (right, back) = across.min(axis=0) - margin, across.max(axis=0) + margin
        corners = np.array([[left, front], [right, front], [right, back], [left, back]])
        flat = self.view.flat(np.column_stack([corners, np.zeros(4)]))
        axes.fill(*flat.T, color=_FAINT, alpha=0.5, lw=0, zorder=0, label="ground")

    def _bodies(self, axes: Any) -> None:
        """Draw ellipsoids of bodies given by inertia, and lines from centres of mass to joints."""
        from matplotlib.patches import Ellipse

        for joint in self.mechanism.joints:
            for body in (joint.parent, joint.child):
                if body != WORLD_INDEX:
                    line = self.view.flat(np.array([self.pose.position[body], self._anchor(joint)]))
                    axes.plot(*line.T, color=_FAINT, linewidth=1.0, zorder=1)
        for body in np.flatnonzero(self.mechanism.particles_per_body == 0).tolist():
            half = outline(self.mechanism, self.pose, self.view, body)
            values, vectors = np.linalg.eigh(half)
            tilt = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
            width, height = 2.0 * np.sqrt(np.maximum(values[::-1], 0.0))
            center = tuple(self.view.flat(self.pose.position[body]))
            look = {"fc": (_BODY, 0.16), "ec": _BODY, "lw": 0.9, "zorder": 2}
            axes.add_patch(Ellipse(center, width, height, angle=tilt, **look))

    def _skeleton(self, axes: Any) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Circle

        nodes = np.concatenate([self.points, self.bones.fixed])
        flat = self.view.flat(nodes)
        lines = [(flat[a], flat[b]) for a, b in self.bones.edges]
        axes.add_collection(LineCollection(lines, colors=PALE, linewidths=1.4, zorder=3))
        bodies = self.mechanism.scene.bodies
        mass = np.array([p.mass for body in bodies for p in body.particles], dtype=float)
        size = self.unit * np.cbrt(mass / mass.max(initial=0.0)) if len(mass) else mass
        near = np.argsort(self.view.depth(self.points[: len(mass)]), kind="stable")
        for place, k in enumerate(near):
            radius = max(float(size[k]), 0.25 * self.unit)
            order = 4.0 + place / (len(near) + 1)
            axes.add_patch(Circle(flat[k], radius, fc=_BODY, ec="white", lw=0.6, zorder=order))
        colour = PARTS["contact sphere"]
        for k in np.flatnonzero(self.bones.radius > 0):
            radius = self.bones.radius[k]
            axes.add_patch(Circle(flat[k], radius, fc="none", ec=colour, lw=1.2, zorder=5))
            axes.plot([], [], "o", mfc="none", color=colour, label="contact sphere")
        fixed = flat[len(self.points) :]
        if len(fixed):
            axes.plot(*fixed.T, "^", color=DRAWN, ms=8, zorder=6, label="fixed point", ls="none")

    def _spring(self, axes: Any, spring: PointPair) -> None:
        """Draw a zigzag, or for a damper alone a straight dashed line."""
        begin, end = self.view.flat(self._ends(spring))
        label = "spring" if spring.damping == 0 else "spring–damper"
        if spring.stiffness == 0:
            line, style, label = np.array([begin, end]), "--", "damper"
        else:
            along = np.linspace(0.0, 1.0, 21)
            side = np.where(np.arange(21) % 2, 1.0, -1.0)
            side[[0, 1, 2, 18, 19, 20]] = 0.0
            direction = end - begin
            normal = np.array([-direction[1], direction[0]])
            normal *= 0.8 * self.unit / max(float(np.hypot(*normal)), 1e-12)
            line, style = begin + along[:, None] * direction + side[:, None] * normal, "-"
        axes.plot(*line.T, style, color=PARTS["spring"], linewidth=1.3, zorder=5, label=label)

    def _joint(self, axes: Any, joint: PlacedJoint) -> None:
        """Draw a ring (ball, hinge), diamond (slider) or square (fixed), and the axis as a bar."""
        colour = PARTS[joint.kind]
        place = self.view.flat(self._anchor(joint))
        marker = {"fixed": "s", "slider": "D"}.get(joint.kind, "o")
        style = {"color": colour, "ls": "none", "mew": 1.3, "zorder": 7, "label": joint.kind}
        axes.plot(*place, marker, ms=4.5, mfc=colour if joint.kind == "fixed" else "white", **style)
        if joint.kind in ("hinge", "slider"):
            reach = (4.0 if joint.kind == "slider" else 2.5) * self.unit
            axis = self.view.flat(self.pose.with_world().arms(joint.parent, joint.axis)) * reach
            line = np.array([place - axis, place + axis])
            width = 2.6 if joint.kind == "slider" else 1.3
            axes.plot(*line.T, color=colour, linewidth=width, zorder=6, solid_capstyle="round")
        if WORLD_INDEX in (joint.parent, joint.child):
            axes.plot(*place, "^", color=DRAWN, ms=11, zorder=5, label="fixed point", ls="none")

    def _center(self, axes: Any) -> None:
        mass = self.mechanism.mass
        place = self.view.flat(mass @ self.pose.position / mass.sum())
        axes.plot(*place, "o", ms=11, mfc="none", mec=DRAWN, mew=1.0, zorder=8)
        axes.plot(*place, "+", ms=11, mec=DRAWN, mew=1.0, zorder=8, label="centre of mass")

    def _names(self, axes: Any) -> None:
        bodies = self.mechanism.scene.bodies
        if not 1 < len(bodies) <= _NAMED_BODIES:
            return
        placed: list[Array] = []
        near = self.unit * np.array([9.0, 3.0])
        for body, place in zip(bodies, self.view.flat(self.pose.position), strict=True):
            close = sum(bool((np.abs(place - other) < near).all()) for other in placed)
            placed.append(place)
            axes.annotate(
                in_figure(body.name), place, xytext=(7, -3 - 13 * close), **_LABEL,
                textcoords="offset points",
                bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 0.6},
            )  # fmt: skip

    def _scale_bar(self, axes: Any) -> None:
        left, right = axes.get_xlim()
        length = _round_number(0.22 * (right - left))
        share = length / (right - left)
        style = {"color": DRAWN, "transform": axes.transAxes, "zorder": 9, "clip_on": False}
        axes.plot([0.96 - share, 0.96], [0.1, 0.1], linewidth=2.0, **style)
        text = _length_text(length)
        axes.text(0.96 - share / 2, 0.11, text, ha="center", transform=axes.transAxes)

    def _directions(self, axes: Any) -> None:
        """Draw the axes of W at the lower left and gravity at the upper right, in fixed size."""
        self._arrows(axes, (0.09, 0.11), [(v, "xyz"[k], PALE) for k, v in enumerate(np.eye(3))])
        gravity = np.array(self.mechanism.scene.gravity)
        size = float(np.hypot(*gravity[:2])) if gravity[2] == 0 else float(np.linalg.norm(gravity))
        if size == 0:
            axes.text(0.96, 0.8, "no gravity", ha="right", transform=axes.transAxes)
            return
        self._arrows(axes, (0.93, 0.8), [(gravity / size, f"{size:g} m/s²", DRAWN)])

    def _arrows(
        self, axes: Any, place: tuple[float, float], arrows: list[tuple[Array, str, str]]
    ) -> None:
        for direction, text, colour in arrows:
            flat = self.view.flat(direction)
            look = {"xycoords": "axes fraction", "color": colour}
            if float(np.hypot(*flat)) < 0.1:
                sign = "⊙" if self.view.depth(direction) > 0 else "⊗"
                axes.annotate(f"{sign} {text}", place, ha="right", va="top", **look)
                continue
            axes.annotate(
                text, place, xytext=tuple(36 * flat), textcoords="offset points", ha="center",
                va="center", **look,
                arrowprops={"arrowstyle": "<-", "color": colour, "shrinkA": 4, "shrinkB": 0},
            )  # fmt: skip

    def _legend(self, axes: Any) -> None:
        handles, labels = axes.get_legend_handles_labels()
        entries = dict(zip(labels, handles, strict=True))
        axes.legend(
            entries.values(), entries.keys(), loc="lower center", bbox_to_anchor=(0.5, 0.0),
            ncols=min(len(entries), 4), frameon=False, fontsize=8,
        )  # fmt: skip

    def _anchor(self, joint: PlacedJoint) -> Array:
        return self.pose.with_world().points(joint.child, joint.in_child)

    def _ends(self, pair: PointPair) -> Array:
        return self.pose.with_world().points(list(pair.bodies), np.array(pair.in_body))


def _round_number(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9))


def _length_text(length: float) -> str:
    units = ((1.0, "m"), (1e-2, "cm"), (1e-3, "mm"))
    size, unit = next((u for u in units if length >= u[0] * (1 - 1e-9)), (1e-6, "µm"))
    return f"{length / size:g} {unit}"


def _title(figure: Any, scene: Scene, start: int | None) -> None:
    row = scene_row(scene)
    mass = float(Mechanism.of(scene).mass.sum())
    pose = "reference pose" if start is None else f"start of trajectory {start}"
    height = figure.get_figheight()
    figure.text(0.04, 1 - 0.3 / height, in_figure(scene.name), fontsize=13, fontweight="bold")
    if scene.description:
        figure.text(0.04, 1 - 0.5 / height, in_figure(scene.description), fontsize=9)
    counts = (
        counted(row.bodies, "body"),
        counted(row.particles, "particle"),
        f"{mass:.4g} kg",
        counted(row.joints, "joint"),
        counted(row.loops, "loop"),
        counted(row.degrees_of_freedom, "degree of freedom", "degrees of freedom"),
        pose,
    )
    figure.text(0.04, 1 - 0.7 / height, " · ".join(counts), fontsize=8, color=PALE)
