"""What a model says, in the terms in which readers are held against each other."""

from __future__ import annotations

from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

from .parts import Freedom, Parts


def facts_of(model: Parts, reader: str) -> ModelFacts:
    """Give the named links that can move, also those fixed to another, and the named joints."""
    body: list[str] = []
    for part in model.parts:
        above = body[part.parent] if part.parent >= 0 else ""
        body.append(part.name if part.freedoms else above)
    parts = [(part, own) for part, own in zip(model.parts, body, strict=True) if own]
    return ModelFacts(
        reader,
        tuple(
            LinkFacts.of(part.name, part.mass.mass, part.mass.com, part.mass.inertia, own)
            for part, own in parts
            if part.named
        ),
        tuple(_joint(freedom) for part, _ in parts for freedom in part.freedoms if freedom.named),
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
