"""The laws of the paper, each written once: consensus, avoidance and topology (assignment: ``leader``).

Inputs and outputs are numbers; nothing here depends on ROS. The formulas of ``consensus`` and
``formation_avoidance`` are scalar functions, called as they are by a single follower and compiled by
``batch.turn_kernels`` for many.
"""
