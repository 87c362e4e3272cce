# the PyTorch adapter, the model and the studies
source .ci/tools/step.sh
# PyTorch comes first: its CPU build then satisfies the range that the package requires
need environment environment torch "$PYTHON" "$TORCH" '.[torch,test,lint]'
PATH="$CI_ENVIRONMENTS/torch/bin:$PATH"
# with PyTorch's own types
check types mypy --strict deepaccident_devkit/training deepaccident_devkit/plugins/model deepaccident_devkit/plugins/study &
export DEEPACCIDENT_REQUIRE_TORCH=1
check tests pytest -q -m "" -n auto -p no:cacheprovider tests/torch_extra tests/parity/test_model.py \
  tests/unit/training/test_without_torch.py
campaign_of_weights() {
  PYTHONPATH=.ci/tools python -m campaign --count 12 --kinds 'weights,weights of PyTorch,weights of old PyTorch,training state'
}
check 'damaged weights' campaign_of_weights
wait
