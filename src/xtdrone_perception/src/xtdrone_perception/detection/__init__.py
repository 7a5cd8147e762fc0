"""Detection of objects in camera images by YOLO networks: node ``yolo.py``."""
