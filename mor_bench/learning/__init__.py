"""Networks: how they are trained, and how they answer fast.

Here: the training loop with its checkpoints, a multilayer perceptron, back ends for single queries,
and the ONNX graph of a network. Not here: any method, and anything that knows a mesh.

This package imports torch. Only methods that train a network import it, so that all others run
without torch. Start with `training.train`; `training_plan` says what it takes, `training_loop` is
one step after another, `checkpoint` is the file that a stopped training resumes from. `inference`
is about predictions.
"""
