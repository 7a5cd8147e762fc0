"""Gazebo's services on models."""
