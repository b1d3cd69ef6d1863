"""The console: commands, flags, sessions, prompt, scripts. It knows commands, never algorithms."""
