"""Many followers of one process computed together, by compiled kernels."""

from .follower_batch import FollowerBatch

__all__ = ["FollowerBatch"]
