"""How far a finished model can be believed: what its photos say of it when they are asked again."""
