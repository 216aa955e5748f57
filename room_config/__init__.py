"""The configuration of a room: one strict TOML file, units in the key names."""
