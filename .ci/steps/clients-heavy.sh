# exports opened by readers that take a long time to install
source .ci/tools/step.sh
need environment environment core "$PYTHON" '.[test,lint]'
check 'environment mmdet3d_infos' environment mmdet3d_infos "$PYTHON" "$TORCH" \
  'numpy<2 mmcv-lite==2.1.0 mmengine==0.10.7 mmdet==3.3.0 mmdet3d==1.4.0'
check 'mmdet3d reads the infos' client mmdet3d_infos
# lerobot needs Python 3.12, and builds of torch for CUDA that are 5 GB
check 'environment lerobot_clips' environment lerobot_clips "$(python_of 3.12)" 'lerobot[dataset]==0.6.1'
check 'lerobot reads the clips' client lerobot_clips
