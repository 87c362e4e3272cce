# exports and data cards opened by other people's readers, nuScenes as a source, and dataroots on S3
source .ci/tools/step.sh
need environment environment core "$PYTHON" '.[test,lint]'

export PIP_COMPILE=1 # old libraries warn when they are compiled, and a test makes warnings errors
check 'environment nuscenes_devkit' environment nuscenes_devkit "$PYTHON" \
  'nuscenes-devkit==1.2.0 motmetrics==1.4.0 pandas<3 numpy<2' "$TORCH numpy<2"
nuscenes="$CI_ENVIRONMENTS/nuscenes_devkit/bin"
# first without this package, as in other people's environments; a run before this one may have left it there
check 'this package is not there' "$nuscenes/pip" uninstall --quiet --yes deepaccident_devkit
check 'nuscenes-devkit reads the export' client nuscenes_devkit
this_package() {
  "$nuscenes/pip" install --quiet '.[nuscenes,torch,test]' 'numpy<2'
  "$nuscenes/pip" install --quiet mlcroissant==1.1.1 'numpy<2'
}
check 'this package beside nuscenes-devkit' this_package
export DEEPACCIDENT_REQUIRE_NUSCENES=1 DEEPACCIDENT_REQUIRE_CROISSANT=1
check 'nuScenes as a source' "$nuscenes/pytest" -q -n auto -p no:cacheprovider tests/road
check 'mlcroissant reads the data card' "$nuscenes/pytest" -q -m slow -p no:cacheprovider \
  tests/unit/validation/test_croissant.py

export PIP_COMPILE=0
check 'environment tables' environment tables "$PYTHON" \
  'datasets==5.2.0 duckdb==2.0.0 polars==2.1.0 pandas==3.1.1 pyarrow==26.0.1 pillow==13.0.0'
check 'datasets, DuckDB and Polars read the export' client tables

# av2's own requirements are pytorch, OpenCV, rerun and others
check 'environment argoverse' environment argoverse "$PYTHON" \
  'numpy==2.4.6 pandas==3.1.1 pyarrow==26.0.1 universal-pathlib==0.3.10' '--no-deps av2==0.3.6'
check 'av2 reads the export' client argoverse

check 'environment rerun_script' environment rerun_script "$PYTHON" 'rerun-sdk==0.41.0'
check 'rerun runs the script of an export' client rerun_script

# s3fs needs its own version of botocore
check 'environment cloud' environment cloud "$PYTHON" '.[test,cloud]'
same_botocore() {
  "$CI_ENVIRONMENTS/cloud/bin/pip" install --quiet 'moto[server]' \
    "botocore==$("$CI_ENVIRONMENTS/cloud/bin/python" -c 'import botocore; print(botocore.__version__)')"
}
check 'a server of S3' same_botocore
export DEEPACCIDENT_REQUIRE_CLOUD=1
check 'dataroots on S3' "$CI_ENVIRONMENTS/cloud/bin/pytest" -q -p no:cacheprovider tests/cloud
