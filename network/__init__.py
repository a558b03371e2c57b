"""The fleet's network: where fixes come from, what delays them on their way, and what arrives."""
