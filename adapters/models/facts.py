"""Facts about a model, in the form in which readers are compared."""

from __future__ import annotations

from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

from .parts import Freedom, Parts


def facts_of(model: Parts, reader: str) -> ModelFacts:
    """Return facts about named joints and named links that move, fixed to another or not."""
    bodies: list[str] = []
    for part in model.parts:
        above = bodies[part.parent] if part.parent >= 0 else ""
        bodies.append(part.name if part.freedoms else above)
    parts = [(part, body) for part, body in zip(model.parts, bodies, strict=True) if body]
    return ModelFacts(
        reader,
        tuple(
            LinkFacts.of(part.name, part.mass.mass, part.mass.com, part.mass.inertia, body)
            for part, body in parts
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
