"""The durable record of one procedure, the only thing the processes share."""
