"""The exploration of a floor by several vehicles; crossing_director.py directs it, see ``crossing``."""
