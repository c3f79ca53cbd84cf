"""MotionStruct4D: one video in, a 4D Gaussian scene with discovered rigid parts out."""
