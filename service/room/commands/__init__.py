"""What may be asked of the control loop, a module a subject."""
