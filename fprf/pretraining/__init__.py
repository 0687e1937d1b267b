"""Training of the networks that ship: small encoders distilled from large ones, and the decoder D_VGG."""
