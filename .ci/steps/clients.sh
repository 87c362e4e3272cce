# exports and data cards opened by other people's readers, nuScenes as a source, and dataroots on S3
source .ci/tools/step.sh
need environment environment core "$PYTHON" '.[test,lint]'

nuscenes_devkit=('nuscenes-devkit==1.2.0 motmetrics==1.4.0 pandas<3 numpy<2' "$TORCH numpy<2")
# first without this package, as in other people's environments
check 'environment nuscenes_devkit' environment nuscenes_devkit "$PYTHON" "${nuscenes_devkit[@]}"
check 'nuscenes-devkit reads the export' client nuscenes_devkit
check 'environment tables' environment tables "$PYTHON" \
  'datasets==5.2.0 duckdb==2.0.0 polars==2.1.0 pandas==3.1.1 pyarrow==26.0.1 pillow==13.0.0'
check 'datasets, DuckDB and Polars read the export' client tables

# av2's own requirements are pytorch, OpenCV, rerun and others
check 'environment argoverse' environment argoverse "$PYTHON" \
  'numpy==2.4.6 pandas==3.1.1 pyarrow==26.0.1 universal-pathlib==0.3.10' '--no-deps av2==0.3.6'
check 'av2 reads the export' client argoverse

check 'environment nuscenes' environment nuscenes "$PYTHON" "${nuscenes_devkit[@]}" \
  '.[nuscenes,torch,test] numpy<2' 'mlcroissant==1.1.1 numpy<2'
nuscenes="$CI_ENVIRONMENTS/nuscenes/bin"
export DEEPACCIDENT_REQUIRE_NUSCENES=1 DEEPACCIDENT_REQUIRE_CROISSANT=1
check 'nuScenes as a source' "$nuscenes/pytest" -q -n auto -p no:cacheprovider tests/road
check 'mlcroissant reads the data card' "$nuscenes/pytest" -q -m slow -p no:cacheprovider \
  tests/unit/validation/test_croissant.py

# s3fs needs its own version of botocore
check 'environment cloud' environment cloud "$PYTHON" '.[test,cloud]'
same_botocore() {
  "$CI_ENVIRONMENTS/cloud/bin/pip" install --quiet 'moto[server]' \
    "botocore==$("$CI_ENVIRONMENTS/cloud/bin/python" -c 'import botocore; print(botocore.__version__)')"
}
check 'a server of S3' same_botocore
export DEEPACCIDENT_REQUIRE_CLOUD=1
check 'dataroots on S3' "$CI_ENVIRONMENTS/cloud/bin/pytest" -q -p no:cacheprovider tests/cloud
