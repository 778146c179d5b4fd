"""Controllers of the identified motion in integers, with the C step of the microcontroller."""
