"""What a site must know before its first case, measured with a phantom on the table."""
