"""Proposals of the mission: phases, references and recovery."""
