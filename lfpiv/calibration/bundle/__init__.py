"""Errors of the board, fitted jointly to the labels of all cameras."""
