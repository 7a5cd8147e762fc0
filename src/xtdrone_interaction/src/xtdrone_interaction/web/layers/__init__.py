"""Layers of the 3D view and the map: paths, clouds, scans and grids of any topic, reduced to what a browser draws."""
