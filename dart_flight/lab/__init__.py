"""What one studies with: it imports the part that flies, and nothing that flies imports it."""
