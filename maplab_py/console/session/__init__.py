"""Sessions and the execution of commands in them: maps, lasting flags, transactions, jobs."""
