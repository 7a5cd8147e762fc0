"""Contacts of vehicles: which of them Bullet integrates, sleep, friction, contact points, and free start poses."""
