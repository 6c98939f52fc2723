"""Sweeps: a search for settings that learn better."""
