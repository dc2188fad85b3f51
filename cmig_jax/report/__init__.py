"""Pictures and pages of what was evaluated; nothing is measured here."""
