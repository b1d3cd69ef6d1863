"""Protobuf messages of map files."""
