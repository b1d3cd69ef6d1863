"""Commands: flags, help, registry, schemas of reports, and the words of a typed line."""
