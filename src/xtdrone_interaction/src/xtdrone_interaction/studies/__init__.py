"""Studies of many flights: their files, runs, execution on Dask, stored rows and pictures.

A flight is a function that is handed in (``dask_execution.Work``); ``sweep`` has the one that flies a swarm.
"""
