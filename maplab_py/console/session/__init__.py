"""What a session holds and how a command runs in it: maps, lasting flags, transactions, jobs."""
