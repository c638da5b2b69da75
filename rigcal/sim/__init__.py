"""Scenes with exact truth: rigs that can be simulated, rendered and measured against."""

from rigcal.sim.rigs import RIGS, Rig
from rigcal.sim.simulation import Simulation, simulate, simulate_rig

__all__ = ["RIGS", "Rig", "Simulation", "simulate", "simulate_rig"]
