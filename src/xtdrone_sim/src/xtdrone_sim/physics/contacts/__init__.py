"""Contacts of vehicles: nearness to obstacles, sleep, and contact points."""
