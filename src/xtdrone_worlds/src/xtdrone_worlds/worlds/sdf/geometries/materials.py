"""Materials of SDF visuals: colours and textures."""

from __future__ import annotations

from dataclasses import replace
from xml.sax.saxutils import escape

from xtdrone_worlds.shapes.visual import Colour, Visual
from xtdrone_worlds.worlds.sdf.models.model_uris import resolve, uri_of
from xtdrone_worlds.worlds.sdf.xml_elements import Element

TEXTURE = "xtdrone:texture"

GREY = (0.7, 0.7, 0.7, 1.0)
# plain materials of Gazebo
_COLOURS = {
    "Gazebo/Grey": (0.7, 0.7, 0.7, 1.0),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175, 1.0),
    "Gazebo/White": (1.0, 1.0, 1.0, 1.0),
    "Gazebo/Black": (0.0, 0.0, 0.0, 1.0),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1, 1.0),
    "Gazebo/Red": (1.0, 0.0, 0.0, 1.0),
    "Gazebo/Green": (0.0, 1.0, 0.0, 1.0),
    "Gazebo/Blue": (0.0, 0.0, 1.0, 1.0),
    "Gazebo/Yellow": (1.0, 1.0, 0.0, 1.0),
    "Gazebo/Orange": (1.0, 0.5088, 0.0468, 1.0),
    "Gazebo/Purple": (1.0, 0.0, 1.0, 1.0),
    "Gazebo/Turquoise": (0.0, 1.0, 1.0, 1.0),
    "Gazebo/Gold": (0.8, 0.64869, 0.12076, 1.0),
    "Gazebo/Wood": (0.56, 0.4, 0.24, 1.0),
    "Gazebo/Bricks": (0.62, 0.34, 0.27, 1.0),
    "Gazebo/Grass": (0.33, 0.48, 0.2, 1.0),
}


def paint(visual: Visual, material: Element) -> Visual:
    """Return a visual with the colour and the texture of a <material>, unchanged without either.

    Raises:
        SdfError: invalid value.
    """
    material.warn_unknown(
        ("ambient", "diffuse", "script", TEXTURE, "pbr"),
        ("specular", "emissive", "lighting", "shader", "shininess", "double_sided", "render_order"),
    )
    colour = _read_colour(material)
    texture = material.one(TEXTURE) or _albedo(material)
    if colour is None and texture is None:
        return visual
    path = None if texture is None else resolve(texture)
    return replace(visual, colour=colour or (1.0, 1.0, 1.0, 1.0), texture=path)


def _read_colour(material: Element) -> Colour | None:
    for tag in ("diffuse", "ambient"):
        element = material.one(tag)
        if element is not None:
            values = element.numbers((3, 4), 0.0, 1.0)
            red, green, blue, opacity = (*values, 1.0)[:4]
            return (red, green, blue, opacity)
    script = material.one("script")
    if script is None:
        return None
    name = script.one("name")
    known = None if name is None else _COLOURS.get(name.text.strip())
    if known is None:
        script.warn_ignored("is not supported and ignored; only Gazebo's plain colours are supported (docs/worlds.md)")
    return known


def _albedo(material: Element) -> Element | None:
    pbr = material.one("pbr")
    metal = None if pbr is None else pbr.one("metal") or pbr.one("specular")
    return None if metal is None else metal.one("albedo_map")


def write_material(visual: Visual) -> str:
    """Write the <material> of a visual."""
    texture = "" if visual.texture is None else f"<{TEXTURE}>{escape(uri_of(visual.texture))}</{TEXTURE}>"
    return f"<material><diffuse>{' '.join(map(repr, visual.colour))}</diffuse>{texture}</material>"
