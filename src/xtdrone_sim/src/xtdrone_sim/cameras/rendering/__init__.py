"""Rendering of scenes, bodies of visuals seen by pinhole cameras, with pybullet (see docs/cameras.md)."""

from xtdrone_sim.cameras.rendering.renderer import BACKENDS, Picture, Renderer, RendererError

__all__ = ["BACKENDS", "Picture", "Renderer", "RendererError"]
