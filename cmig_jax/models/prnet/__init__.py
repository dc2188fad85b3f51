"""PRNet: Partial Registration Network (Wang and Solomon, NeurIPS 2019): `flags`, and `network`, which reads top-down."""
