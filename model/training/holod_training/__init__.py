"""Trains, judges and exports holod's pupil-adaptive hologram networks."""
