"""The recorded cases of the networks beside CMIGNet, a file for each; `method.py` has what they share."""
