"""What comes over the network: requests as odd as senders make them, and how associations end."""
