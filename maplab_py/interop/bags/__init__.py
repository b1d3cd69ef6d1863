"""Maps as bags: their poses beside the messages of a recording, or all that they have."""
