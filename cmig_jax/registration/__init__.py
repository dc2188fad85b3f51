"""Registration of a user's own two clouds."""
