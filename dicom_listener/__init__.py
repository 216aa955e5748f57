"""C-STORE SCP, durable inbox, headers, assignment of slices to commanded shifts."""
