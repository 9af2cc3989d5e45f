"""What the selector sees, how it chooses, and the answer that the switch makes of it."""
