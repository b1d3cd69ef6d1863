"""What is drawn, one module per family of layers; each builds plain arrays from a map."""
