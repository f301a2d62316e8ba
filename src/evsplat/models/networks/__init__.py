"""Networks that models share: encodings, pose encoder, deformation, skinning and colour."""
