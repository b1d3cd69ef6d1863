"""Writers under faults: every system call of a save fails or is the last one before a crash."""
