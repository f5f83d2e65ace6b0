"""What a model says, in the terms in which readers are held against each other."""

from __future__ import annotations

from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

from .parts import Freedom, Parts


def facts_of(model: Parts, reader: str) -> ModelFacts:
    """Give the named links that can move, also those fixed to another, and the named joints."""
    moving: list[bool] = []
    for part in model.parts:
        moving.append(bool(part.freedoms) or (part.parent >= 0 and moving[part.parent]))
    parts = [part for part, moves in zip(model.parts, moving, strict=True) if moves]
    return ModelFacts(
        reader,
        tuple(
            LinkFacts.of(p.name, p.mass.mass, p.mass.com, p.mass.inertia) for p in parts if p.named
        ),
        tuple(_joint(freedom) for part in parts for freedom in part.freedoms if freedom.named),
        len(model.couplings),
    )


def _joint(freedom: Freedom) -> JointFacts:
    properties = {key: value for key, value in freedom.properties.items() if key != "rest"}
    return JointFacts(
        name=freedom.name,
        kind=freedom.kind,
        anchor=freedom.anchor.tolist(),
        axis=freedom.axis.tolist(),
        **properties,  # type: ignore[arg-type]
    )
