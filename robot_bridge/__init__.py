"""The daemon in the scanner room: wire protocol, motor drivers, emulated controller."""
