"""DCP: Deep Closest Point (Wang and Solomon, ICCV 2019), versions 1 and 2: `flags`, and `network`, which reads top-down."""
