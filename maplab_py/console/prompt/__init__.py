"""The interactive prompt: completion, colouring, history."""
