"""Following of a detected person: node ``yolo_human_tracking.py``."""
