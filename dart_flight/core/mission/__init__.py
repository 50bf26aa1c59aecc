"""What is proposed: phases, references, recovery."""
