"""What the pages claim, measured: a folder for every question, all run as `python -m experiments.FOLDER.FILE`.

speed       how long a call takes, beside PyTorch and beside other formulations
quality     how good results are, for what cost: samplers, schedules, training, long sequences
stability   what the model and its training stand, and where they break
planning    what the planner spends and loses
scaling     memory, communication and work of models too large to run here
ablation    which parts of the small model earn their keep
drawings    pictures of the pages that show no result
results     what was measured: JSON, pictures

`harness.py` is what they share. docs/development/figures.md has the commands.
"""
