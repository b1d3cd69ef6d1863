"""What a map consists of, in numbers and in bytes."""
