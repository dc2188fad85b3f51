"""Pictures and pages of evaluations and registrations; the results they show are given."""
