"""What the system believes and by what it judges, as a screen shows it."""
